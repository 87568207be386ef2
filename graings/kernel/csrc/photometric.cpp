#include "photometric.hpp"

#include <algorithm>

#include "buffer.hpp"
#include "isa.hpp"
#include "pool.hpp"

namespace graings {

template <class R>
Likeness compare(int64_t height, int64_t width, const R* image, const R* target, Likeness weights, R* gradient, int threads) {
    constexpr int64_t kBand = 16;  // rows
    const Kernels<R>& run = kernels<R>();
    const int64_t bands = (height + kBand - 1) / kBand, row = 3 * width + 2 * 15 + 2 * kLanes;
    const double scale = 1.0 / (3.0 * double(height) * double(width));
    Buffer<double> sums{size_t(2 * bands)};
    Buffer<R> maps(gradient ? size_t(9 * height * width) : 1), scratch(size_t(threads) * size_t(5 * row));
    const SsimArgs<R> args{height, width, image, target, gradient, gradient ? maps.get() : nullptr, sums.get(), R(weights.similarity * scale), R(weights.absolute * scale)};
    const auto end = [&](int64_t band) { return std::min(height, (band + 1) * kBand); };
    parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_values(args, band, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    if (gradient)
        parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_gradient(args, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    Likeness mean{};
    for (int64_t band = 0; band < bands; band++) mean.similarity += sums[size_t(2 * band)] * scale, mean.absolute += sums[size_t(2 * band + 1)] * scale;
    return mean;
}

template Likeness compare<float>(int64_t, int64_t, const float*, const float*, Likeness, float*, int);
template Likeness compare<double>(int64_t, int64_t, const double*, const double*, Likeness, double*, int);

}  // namespace graings
