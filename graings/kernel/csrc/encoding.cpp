#include "encoding.hpp"

#include <algorithm>
#include <cmath>

#include "pool.hpp"

namespace graings {

namespace {

constexpr int64_t kPiece = 1024;  // rows per piece of work

template <class Each>
void each_row(int threads, int64_t rows, Each each) {
    parallel_for(threads, (rows + kPiece - 1) / kPiece, [&](int, int64_t piece) {
        for (int64_t row = piece * kPiece; row < std::min(rows, (piece + 1) * kPiece); row++) each(row);
    });
}

constexpr int width_of(int degree) { return degree * (degree + 2); }

// Factors that give each harmonic a mean square of 1/3 over all directions.
const double kA = std::sqrt(5.0), kB = std::sqrt(35.0 / 24), kC = std::sqrt(35.0), kD = std::sqrt(7.0 / 8), kE = std::sqrt(7.0 / 12), kF = std::sqrt(5.0 / 12);

template <class R>
void harmonics(int degree, const double (&at)[3], R* out) {
    const double x = at[0], y = at[1], z = at[2], xx = x * x, yy = y * y, zz = z * z;
    out[0] = R(x), out[1] = R(y), out[2] = R(z);
    if (degree < 2) return;
    out[3] = R(kA * x * y), out[4] = R(kA * y * z), out[5] = R(kF * (3 * zz - 1)), out[6] = R(kA * x * z), out[7] = R(kA / 2 * (xx - yy));
    if (degree < 3) return;
    out[8] = R(kB * y * (3 * xx - yy)), out[9] = R(kC * x * y * z), out[10] = R(kD * y * (5 * zz - 1)), out[11] = R(kE * z * (5 * zz - 3));
    out[12] = R(kD * x * (5 * zz - 1)), out[13] = R(kC / 2 * z * (xx - yy)), out[14] = R(kB * x * (xx - 3 * yy));
}

template <class R>
void harmonics_gradient(int degree, const double (&at)[3], const R* v, double (&gradient)[3]) {
    const double x = at[0], y = at[1], z = at[2], xx = x * x, yy = y * y, zz = z * z;
    double gx = v[0], gy = v[1], gz = v[2];
    if (degree >= 2) {
        const double v3 = kA * v[3], v4 = kA * v[4], v6 = kA * v[6], v7 = kA * v[7];
        gx += v3 * y + v6 * z + v7 * x, gy += v3 * x + v4 * z - v7 * y, gz += v4 * y + v6 * x + 6 * kF * z * v[5];
    }
    if (degree >= 3) {
        const double v8 = kB * v[8], v9 = kC * v[9], v10 = kD * v[10], v12 = kD * v[12], v13 = kC * v[13], v14 = kB * v[14];
        gx += 6 * v8 * x * y + v9 * y * z + v12 * (5 * zz - 1) + v13 * x * z + 3 * v14 * (xx - yy);
        gy += 3 * v8 * (xx - yy) + v9 * x * z + v10 * (5 * zz - 1) - v13 * y * z - 6 * v14 * x * y;
        gz += v9 * x * y + 10 * z * (v10 * y + v12 * x) + kE * (15 * zz - 3) * v[11] + v13 / 2 * (xx - yy);
    }
    gradient[0] = gx, gradient[1] = gy, gradient[2] = gz;
}

// A direction reflected at the plane with the given normal, of any length.
struct Mirror {
    double direction[3], normal[3], squared, along;  // along: direction . normal / squared

    template <class R>
    Mirror(const R* of, const R* at) : direction{of[0], of[1], of[2]}, normal{at[0], at[1], at[2]} {
        constexpr double kEpsilon = 1e-6;  // normals shorter than 1e-3 reflect less and less, instead of in an undefined direction
        squared = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] + kEpsilon;
        along = (direction[0] * normal[0] + direction[1] * normal[1] + direction[2] * normal[2]) / squared;
    }
    void image(double (&out)[3]) const {
        for (int i = 0; i < 3; i++) out[i] = direction[i] - 2 * along * normal[i];
    }
    template <class R>
    void gradient(const double (&v)[3], R* out) const {
        const double turned = (v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2]) / squared;
        for (int i = 0; i < 3; i++) out[i] = R(-2 * (along * v[i] + turned * (direction[i] - 2 * along * normal[i])));
    }
};

}  // namespace

template <class R>
void encode(int64_t rows, int64_t dimensions, int octaves, const R* x, R* out, int threads) {
    const int64_t width = dimensions * (1 + 2 * octaves);
    each_row(threads, rows, [&](int64_t row) {
        R* to = out + row * width;
        for (int64_t d = 0; d < dimensions; d++) {
            const double value = double(x[row * dimensions + d]);
            to[d] = R(value);
            // One sine and cosine, then double-angle formulas: each octave costs a bit, and float64 has 29 more than float32.
            double sine = std::sin(value), cosine = std::cos(value);
            R *sines = to + dimensions + d * octaves, *cosines = sines + dimensions * octaves;
            for (int l = 0; l < octaves; l++) {
                sines[l] = R(sine), cosines[l] = R(cosine);
                const double twice = 2 * sine * cosine;
                cosine = (cosine - sine) * (cosine + sine), sine = twice;
            }
        }
    });
}

template <class R>
void encode_directions(int64_t rows, int degree, const R* directions, const R* normals, R* out, int threads) {
    const int width = width_of(degree);
    each_row(threads, rows, [&](int64_t row) {
        const R* direction = directions + 3 * row;
        R* to = out + row * width * (normals ? 2 : 1);
        harmonics(degree, {double(direction[0]), double(direction[1]), double(direction[2])}, to);
        if (!normals) return;
        double image[3];
        Mirror(direction, normals + 3 * row).image(image);
        harmonics(degree, image, to + width);
    });
}

template <class R>
void encode_directions_gradient(int64_t rows, int degree, const R* directions, const R* normals, const R* v_out, R* v_normals, int threads) {
    const int width = width_of(degree);
    each_row(threads, rows, [&](int64_t row) {
        const Mirror mirror(directions + 3 * row, normals + 3 * row);
        double image[3], v_image[3];
        mirror.image(image);
        harmonics_gradient(degree, image, v_out + (2 * row + 1) * width, v_image);
        mirror.gradient(v_image, v_normals + 3 * row);
    });
}

template void encode(int64_t, int64_t, int, const float*, float*, int);
template void encode(int64_t, int64_t, int, const double*, double*, int);
template void encode_directions(int64_t, int, const float*, const float*, float*, int);
template void encode_directions(int64_t, int, const double*, const double*, double*, int);
template void encode_directions_gradient(int64_t, int, const float*, const float*, const float*, float*, int);
template void encode_directions_gradient(int64_t, int, const double*, const double*, const double*, double*, int);

}  // namespace graings
