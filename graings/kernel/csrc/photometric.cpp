#include "photometric.hpp"

#include <algorithm>
#include <vector>

#include "buffer.hpp"
#include "isa.hpp"
#include "pool.hpp"

namespace graings {

namespace {

constexpr int64_t kReach = kSsimRadius;

// For each row, the range from the first to the last differing pixel; [width, 0) if none. NaN differs from everything.
template <class R>
std::vector<Range> differing(int64_t height, int64_t width, const R* image, const R* target) {
    std::vector<Range> parts(size_t(height), Range{width, 0});
    for (int64_t y = 0; y < height; y++) {
        const R *a = image + 3 * y * width, *b = target + 3 * y * width;
        int64_t first = 0, last = 3 * width;
        while (first < last && a[first] == b[first]) first++;
        if (first == last) continue;
        while (a[last - 1] == b[last - 1]) last--;
        parts[size_t(y)] = {first / 3, (last + 2) / 3};
    }
    return parts;
}

// For each row, the range of pixels within the window's radius of the ranges `parts`.
std::vector<Range> widened(const std::vector<Range>& parts, int64_t width) {
    const int64_t height = int64_t(parts.size());
    std::vector<Range> wide(parts.size(), Range{width, 0});
    for (int64_t y = 0; y < height; y++) {
        Range& all = wide[size_t(y)];
        for (int64_t row = std::max<int64_t>(0, y - kReach); row < std::min(height, y + kReach + 1); row++)
            all.begin = std::min(all.begin, parts[size_t(row)].begin), all.end = std::max(all.end, parts[size_t(row)].end);
        if (all.begin < all.end) all = {std::max<int64_t>(0, all.begin - kReach), std::min(width, all.end + kReach)};
    }
    return wide;
}

}  // namespace

template <class R>
PhotometricTerms compare(int64_t height, int64_t width, const R* image, const R* target, PhotometricTerms weights, R* gradient, int threads) {
    constexpr int64_t kBand = 16;  // rows
    const Kernels<R>& run = kernels<R>();
    // Windows centred outside `windows` contain no difference; pixels outside `affected` are in no window that does.
    std::vector<Range> windows = widened(differing(height, width, image, target), width), affected = widened(windows, width);
    Range across{width, 0}, down{height, 0};
    for (int64_t y = 0; y < height; y++) {
        const Range& row = affected[size_t(y)];
        if (row.begin >= row.end) continue;
        across = {std::min(across.begin, row.begin), std::max(across.end, row.end)};
        down = {std::min(down.begin, y), y + 1};
    }
    if (down.begin >= down.end) across = down = {0, 0};
    const int64_t rows = down.end - down.begin, columns = across.end - across.begin, first = 3 * (down.begin * width + across.begin);
    const auto numbers = [&](std::vector<Range>& parts) {  // from pixels of the image to numbers of the bounding box
        int64_t count = 0;
        for (Range& part : parts) {
            part = part.begin < part.end ? Range{3 * (part.begin - across.begin), 3 * (part.end - across.begin)} : Range{0, 0};
            count += part.end - part.begin;
        }
        return count;
    };
    const int64_t all = 3 * height * width, seen = numbers(windows), written = numbers(affected);
    const int64_t bands = (rows + kBand - 1) / kBand, row = 3 * columns + 2 * 15 + 2 * kLanes;
    const double scale = 1.0 / double(all);
    Buffer<double> sums{size_t(3 * bands)};
    Buffer<R> maps(gradient ? size_t(9 * rows * columns) : 1), scratch(size_t(threads) * size_t(5 * row));
    const SsimArgs<R> args{rows, columns, 3 * width, image + first, target + first, windows.data() + down.begin, affected.data() + down.begin,
                           gradient ? gradient + first : nullptr, gradient ? maps.get() : nullptr, sums.get(),
                           R(weights.similarity * scale), R(weights.absolute * scale), R(weights.squared * scale)};
    if (gradient && written < all) std::fill_n(gradient, all, R(0));
    const auto end = [&](int64_t band) { return std::min(rows, (band + 1) * kBand); };
    parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_values(args, band, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    if (gradient)
        parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_gradient(args, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    PhotometricTerms sum{double(all - seen), 0.0, 0.0};
    for (int64_t band = 0; band < bands; band++) {
        const double* of_band = sums.get() + 3 * band;
        sum.similarity += of_band[0], sum.absolute += of_band[1], sum.squared += of_band[2];
    }
    return {sum.similarity / double(all), sum.absolute / double(all), sum.squared / double(all)};
}

template PhotometricTerms compare<float>(int64_t, int64_t, const float*, const float*, PhotometricTerms, float*, int);
template PhotometricTerms compare<double>(int64_t, int64_t, const double*, const double*, PhotometricTerms, double*, int);

}  // namespace graings
