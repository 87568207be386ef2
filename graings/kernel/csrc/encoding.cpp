#include "encoding.hpp"

#include <algorithm>
#include <cmath>

#include "pool.hpp"

namespace graings {

template <class R>
void encode(int64_t rows, int64_t dimensions, int octaves, const R* x, R* out, int threads) {
    constexpr int64_t kPiece = 1024;
    const int64_t width = dimensions * (1 + 2 * octaves);
    parallel_for(threads, (rows + kPiece - 1) / kPiece, [&](int, int64_t piece) {
        for (int64_t row = piece * kPiece; row < std::min(rows, (piece + 1) * kPiece); row++) {
            R* to = out + row * width;
            for (int64_t d = 0; d < dimensions; d++) {
                const double value = double(x[row * dimensions + d]);
                to[d] = R(value);
                // One sine and cosine, then doubled angles: an octave loses a bit, and float64 has 29 to spare.
                double sine = std::sin(value), cosine = std::cos(value);
                R *sines = to + dimensions + d * octaves, *cosines = sines + dimensions * octaves;
                for (int l = 0; l < octaves; l++) {
                    sines[l] = R(sine), cosines[l] = R(cosine);
                    const double twice = 2 * sine * cosine;
                    cosine = (cosine - sine) * (cosine + sine), sine = twice;
                }
            }
        }
    });
}

template void encode(int64_t, int64_t, int, const float*, float*, int);
template void encode(int64_t, int64_t, int, const double*, double*, int);

}  // namespace graings
