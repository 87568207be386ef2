#include "photometric.hpp"

#include <algorithm>

#include "buffer.hpp"
#include "isa.hpp"
#include "pool.hpp"

namespace graings {

namespace {

struct Part {
    int64_t top, bottom, left, right;  // rows and columns [top, bottom) x [left, right)
};

// The part of two images that they differ in, with a rim of twice the window's radius. Outside, similarity is 1 and
// the gradient 0: no window there sees a difference, whatever lies beyond the rim. NaN differs from everything.
template <class R>
Part differing(int64_t height, int64_t width, const R* image, const R* target) {
    constexpr int64_t kRim = 10;
    Part part{height, 0, width, 0};
    for (int64_t y = 0; y < height; y++) {
        const R *a = image + 3 * y * width, *b = target + 3 * y * width;
        int64_t first = 0, last = 3 * width;
        while (first < last && a[first] == b[first]) first++;
        if (first == last) continue;
        while (a[last - 1] == b[last - 1]) last--;
        part.top = std::min(part.top, y), part.bottom = y + 1;
        part.left = std::min(part.left, first / 3), part.right = std::max(part.right, (last + 2) / 3);
    }
    if (part.top >= part.bottom) return {0, 0, 0, 0};
    return {std::max<int64_t>(0, part.top - kRim), std::min(height, part.bottom + kRim), std::max<int64_t>(0, part.left - kRim), std::min(width, part.right + kRim)};
}

}  // namespace

template <class R>
Likeness compare(int64_t height, int64_t width, const R* image, const R* target, Likeness weights, R* gradient, int threads) {
    constexpr int64_t kBand = 16;  // rows
    const Kernels<R>& run = kernels<R>();
    const Part part = differing(height, width, image, target);
    const int64_t rows = part.bottom - part.top, columns = part.right - part.left, first = 3 * (part.top * width + part.left);
    const int64_t bands = (rows + kBand - 1) / kBand, row = 3 * columns + 2 * 15 + 2 * kLanes;
    const double scale = 1.0 / (3.0 * double(height) * double(width));
    Buffer<double> sums{size_t(3 * bands)};
    Buffer<R> maps(gradient ? size_t(9 * rows * columns) : 1), scratch(size_t(threads) * size_t(5 * row));
    const SsimArgs<R> args{rows, columns, 3 * width, image + first, target + first, gradient ? gradient + first : nullptr, gradient ? maps.get() : nullptr, sums.get(),
                           R(weights.similarity * scale), R(weights.absolute * scale), R(weights.squared * scale)};
    if (gradient && rows * columns < height * width) std::fill_n(gradient, 3 * height * width, R(0));
    const auto end = [&](int64_t band) { return std::min(rows, (band + 1) * kBand); };
    parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_values(args, band, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    if (gradient)
        parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_gradient(args, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    Likeness mean{1.0 - double(rows * columns) / (double(height) * double(width)), 0.0, 0.0};
    for (int64_t band = 0; band < bands; band++) {
        const double* of_band = sums.get() + 3 * band;
        mean.similarity += of_band[0] * scale, mean.absolute += of_band[1] * scale, mean.squared += of_band[2] * scale;
    }
    return mean;
}

template Likeness compare<float>(int64_t, int64_t, const float*, const float*, Likeness, float*, int);
template Likeness compare<double>(int64_t, int64_t, const double*, const double*, Likeness, double*, int);

}  // namespace graings
