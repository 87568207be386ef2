// Structural similarity in the 3DGS definition (11x11 Gaussian window, sigma 1.5, zero padding, per channel), the
// absolute and the squared difference, and the gradient of a mixture of the three with respect to the first image. Rows
// are independent: any split over threads gives the same bits.
#pragma once
#include "tiles.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kRadius = 5;
constexpr int kPad = 3 * kRadius;  // a neighbouring pixel is three numbers away
// exp(-k^2 / 4.5) for k = 0..5, normalised over the 11 taps
constexpr double kTaps[kRadius + 1] = {0.2660117248617943,   0.21300553771125366,  0.1093606895097,
                                       0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};

template <class R>
GRAINGS_INLINE P<R> load_some(const R* p, int64_t n) {
    if (n >= kLanes) return load<kLanes>(p);
    R lanes[kLanes] = {};
    std::memcpy(lanes, p, sizeof(R) * size_t(n));
    return load<kLanes>(lanes);
}
template <class R>
GRAINGS_INLINE void store_some(R* p, int64_t n, P<R> value) {
    if (n >= kLanes) return store(p, value);
    R lanes[kLanes];
    store(lanes, value);
    std::memcpy(p, lanes, sizeof(R) * size_t(n));
}

// Row length of the scratch: zeros left and right so that the horizontal pass needs no bounds.
GRAINGS_INLINE int64_t padded(int64_t width) { return 3 * width + 2 * kPad + 2 * kLanes; }

template <class R>
GRAINGS_INLINE P<R> across(const R* row) {
    P<R> sum = p16(R(0));
    for (int k = -kRadius; k <= kRadius; k++) sum = fma(load<kLanes>(row + 3 * k), p16(R(kTaps[k < 0 ? -k : k])), sum);
    return sum;
}

// Values of rows [begin, end): their sums go to sums[3 * band]; with a gradient wanted, its three maps are kept.
template <class R>
static void ssim_values(const SsimArgs<R>& args, int64_t band, int64_t begin, int64_t end, R* scratch) {
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    const R c1 = R(0.01 * 0.01), c2 = R(0.03 * 0.03);
    std::memset(scratch, 0, sizeof(R) * size_t(5 * stride));
    double total = 0, apart = 0, squared = 0;
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kRadius ? -y : -kRadius, bottom = args.height - 1 - y < kRadius ? args.height - 1 - y : kRadius;
        for (int64_t x = 0; x < length; x += kLanes) {
            P<R> sx = p16(R(0)), sy = sx, sxx = sx, syy = sx, sxy = sx;
            for (int64_t k = top; k <= bottom; k++) {
                const P<R> tap = p16(R(kTaps[k < 0 ? -k : k]));
                const P<R> a = load_some(args.image + (y + k) * args.row + x, length - x);
                const P<R> b = load_some(args.target + (y + k) * args.row + x, length - x);
                const P<R> ta = tap * a, tb = tap * b;
                sx = sx + ta, sy = sy + tb, sxx = fma(ta, a, sxx), syy = fma(tb, b, syy), sxy = fma(ta, b, sxy);
            }
            R* out = scratch + kPad + x;
            store_some(out, length - x, sx), store_some(out + stride, length - x, sy), store_some(out + 2 * stride, length - x, sxx);
            store_some(out + 3 * stride, length - x, syy), store_some(out + 4 * stride, length - x, sxy);
        }
        for (int64_t x = 0; x < length; x += kLanes) {
            const R* in = scratch + kPad + x;
            const P<R> zero = p16(R(0)), one = p16(R(1)), two = p16(R(2));
            const P<R> mx = across(in), my = across(in + stride);
            const P<R> vx = across(in + 2 * stride) - mx * mx, vy = max(across(in + 3 * stride) - my * my, zero);
            const P<R> vxy = across(in + 4 * stride) - mx * my;
            const P<R> a1 = fma(two * mx, my, p16(c1)), a2 = fma(two, vxy, p16(c2));
            const P<R> b1 = fma(mx, mx, fma(my, my, p16(c1))), b2 = max(vx, zero) + vy + p16(c2);
            const P<R> inverse = one / (b1 * b2), raw = a1 * a2 * inverse;
            R lanes[kLanes], differences[kLanes];
            const P<R> difference = load_some(args.image + y * args.row + x, length - x) - load_some(args.target + y * args.row + x, length - x);
            store(lanes, clamp(raw, zero - one, one)), store(differences, max(difference, zero - difference));
            const int64_t n = length - x < kLanes ? length - x : kLanes;
            for (int64_t i = 0; i < n; i++) {
                const double d = double(differences[i]);
                total += double(lanes[i]), apart += d, squared += d * d;
            }
            if (!args.maps) continue;
            const auto inside = [&](P<R> value) { return select(raw <= one, select(zero - one <= raw, value, zero), zero); };
            const P<R> g_vxy = two * a1 * inverse;
            const P<R> g_vx = select(zero <= vx, zero - raw * b1 * inverse, zero);
            const P<R> g_mx = two * (my * a2 * inverse - raw * mx * b2 * inverse) - g_vxy * my - two * g_vx * mx;
            R* map = args.maps + y * length + x;
            store_some(map, length - x, inside(g_mx)), store_some(map + plane, length - x, inside(g_vx));
            store_some(map + 2 * plane, length - x, inside(g_vxy));
        }
    }
    args.sums[3 * band] = total, args.sums[3 * band + 1] = apart, args.sums[3 * band + 2] = squared;
}

// Filters the maps back: the window is symmetric, so the adjoint of the filter is the filter.
template <class R>
static void ssim_gradient(const SsimArgs<R>& args, int64_t begin, int64_t end, R* scratch) {
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    std::memset(scratch, 0, sizeof(R) * size_t(3 * stride));
    const P<R> zero = p16(R(0)), similarity = p16(args.similarity), absolute = p16(args.absolute), squared = p16(R(2) * args.squared);
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kRadius ? -y : -kRadius, bottom = args.height - 1 - y < kRadius ? args.height - 1 - y : kRadius;
        for (int64_t x = 0; x < length; x += kLanes) {
            P<R> sums[3] = {p16(R(0)), p16(R(0)), p16(R(0))};
            for (int64_t k = top; k <= bottom; k++) {
                const P<R> tap = p16(R(kTaps[k < 0 ? -k : k]));
                for (int m = 0; m < 3; m++) sums[m] = fma(tap, load_some(args.maps + m * plane + (y + k) * length + x, length - x), sums[m]);
            }
            for (int m = 0; m < 3; m++) store_some(scratch + m * stride + kPad + x, length - x, sums[m]);
        }
        for (int64_t x = 0; x < length; x += kLanes) {
            const R* in = scratch + kPad + x;
            const int64_t at = y * args.row + x, n = length - x;
            const P<R> image = load_some(args.image + at, n), target = load_some(args.target + at, n);
            const P<R> g = fma(p16(R(2)) * image, across(in + stride), fma(target, across(in + 2 * stride), across(in)));
            const P<R> sign = select(target < image, absolute, select(image < target, zero - absolute, zero));
            store_some(args.gradient + at, n, fma(similarity, g, fma(squared, image - target, sign)));
        }
    }
}

}  // namespace graings::GRAINGS_ISA
