// Structural similarity in the 3DGS definition (11x11 Gaussian window, sigma 1.5, zero padding, per channel), the
// absolute and the squared difference, and the gradient of a mixture of the three with respect to the first image. Rows
// are independent: any split over threads gives the same bits.
#pragma once
#include <type_traits>

#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kRadius = 5;
constexpr int kPad = 3 * kRadius;  // a neighbouring pixel is three numbers away
// exp(-k^2 / 4.5) for k = 0..5, normalised over the 11 taps
constexpr double kTaps[kRadius + 1] = {0.2660117248617943,   0.21300553771125366,  0.1093606895097,
                                       0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};

// As many numbers as a register holds: what is summed over a window stays in registers on every instruction set.
template <class R> constexpr int kAbreast = kNative<R>;
template <class R> using Abreast = Vec<R, kAbreast<R>>;
template <class R> GRAINGS_INLINE Abreast<R> abreast(R x) { return splat<R, kAbreast<R>>(x); }

// The numbers of a row from `x` on, of which `left` remain: all of a register, or zeros behind.
template <bool Whole, class R>
GRAINGS_INLINE Abreast<R> take(const R* p, int64_t left) {
    if constexpr (Whole) return load<kAbreast<R>>(p);
    R lanes[kAbreast<R>] = {};
    std::memcpy(lanes, p, sizeof(R) * size_t(left));
    return load<kAbreast<R>>(lanes);
}
template <bool Whole, class R>
GRAINGS_INLINE void put(R* p, int64_t left, Abreast<R> value) {
    if constexpr (Whole) return store(p, value);
    R lanes[kAbreast<R>];
    store(lanes, value);
    std::memcpy(p, lanes, sizeof(R) * size_t(left));
}
// Calls each(x, numbers left, whole) for a part of a row, a register at a time.
template <class R, class Each>
GRAINGS_INLINE void along(Range part, Each each) {
    int64_t x = part.begin;
    for (; x + kAbreast<R> <= part.end; x += kAbreast<R>) each(x, part.end - x, std::true_type());
    if (x < part.end) each(x, part.end - x, std::false_type());
}
// What the window reaches from there, in a row of so many numbers.
GRAINGS_INLINE Range reached(Range part, int64_t length) {
    if (part.begin >= part.end) return part;
    return {part.begin < kPad ? 0 : part.begin - kPad, part.end + kPad > length ? length : part.end + kPad};
}

// Row length of the scratch: zeros left and right so that the horizontal pass needs no bounds.
GRAINGS_INLINE int64_t padded(int64_t width) { return 3 * width + 2 * kPad + 2 * kLanes; }

template <class R>
GRAINGS_INLINE Abreast<R> across(const R* row) {
    Abreast<R> sum = abreast(R(0));
    for (int k = -kRadius; k <= kRadius; k++) sum = fma(load<kAbreast<R>>(row + 3 * k), abreast(R(kTaps[k < 0 ? -k : k])), sum);
    return sum;
}

// Values of rows [begin, end): their sums go to sums[3 * band]; with a gradient wanted, its three maps are kept.
template <class R>
static void ssim_values(const SsimArgs<R>& args, int64_t band, int64_t begin, int64_t end, R* scratch) {
    using V = Abreast<R>;
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    const R c1 = R(0.01 * 0.01), c2 = R(0.03 * 0.03);
    const V zero = abreast(R(0)), one = abreast(R(1)), two = abreast(R(2));
    std::memset(scratch, 0, sizeof(R) * size_t(5 * stride));
    auto total = splat<double, kAbreast<R>>(0), apart = total, squared = total;
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kRadius ? -y : -kRadius, bottom = args.height - 1 - y < kRadius ? args.height - 1 - y : kRadius;
        along<R>(reached(args.windows[y], length), [&](int64_t x, int64_t left, auto whole) {
            V sx = zero, sy = zero, sxx = zero, syy = zero, sxy = zero;
            for (int64_t k = top; k <= bottom; k++) {
                const V tap = abreast(R(kTaps[k < 0 ? -k : k]));
                const V a = take<whole>(args.image + (y + k) * args.row + x, left);
                const V b = take<whole>(args.target + (y + k) * args.row + x, left);
                const V ta = tap * a, tb = tap * b;
                sx = sx + ta, sy = sy + tb, sxx = fma(ta, a, sxx), syy = fma(tb, b, syy), sxy = fma(ta, b, sxy);
            }
            R* out = scratch + kPad + x;
            put<whole>(out, left, sx), put<whole>(out + stride, left, sy), put<whole>(out + 2 * stride, left, sxx);
            put<whole>(out + 3 * stride, left, syy), put<whole>(out + 4 * stride, left, sxy);
        });
        if (args.maps)
            for (int m = 0; m < 3; m++) {
                R* map = args.maps + m * plane + y * length;
                std::memset(map, 0, sizeof(R) * size_t(args.windows[y].begin));
                std::memset(map + args.windows[y].end, 0, sizeof(R) * size_t(length - args.windows[y].end));
            }
        along<R>(args.windows[y], [&](int64_t x, int64_t left, auto whole) {
            const R* in = scratch + kPad + x;
            const V mx = across(in), my = across(in + stride);
            const V vx = across(in + 2 * stride) - mx * mx, vy = max(across(in + 3 * stride) - my * my, zero);
            const V vxy = across(in + 4 * stride) - mx * my;
            const V a1 = fma(two * mx, my, abreast(c1)), a2 = fma(two, vxy, abreast(c2));
            const V b1 = fma(mx, mx, fma(my, my, abreast(c1))), b2 = max(vx, zero) + vy + abreast(c2);
            const V inverse = one / (b1 * b2), raw = a1 * a2 * inverse;
            const V difference = take<whole>(args.image + y * args.row + x, left) - take<whole>(args.target + y * args.row + x, left);
            R lanes[kAbreast<R>], differences[kAbreast<R>];
            store(lanes, clamp(raw, zero - one, one)), store(differences, max(difference, zero - difference));
            for (int64_t i = left; !whole && i < kAbreast<R>; i++) lanes[i] = 0;
            const auto distance = load_as<kAbreast<R>>(differences);
            total = total + load_as<kAbreast<R>>(lanes), apart = apart + distance, squared = fma(distance, distance, squared);
            if (!args.maps) return;
            const auto inside = [&](V value) { return select(raw <= one, select(zero - one <= raw, value, zero), zero); };
            const V g_vxy = two * a1 * inverse;
            const V g_vx = select(zero <= vx, zero - raw * b1 * inverse, zero);
            const V g_mx = two * (my * a2 * inverse - raw * mx * b2 * inverse) - g_vxy * my - two * g_vx * mx;
            R* map = args.maps + y * length + x;
            put<whole>(map, left, inside(g_mx)), put<whole>(map + plane, left, inside(g_vx)), put<whole>(map + 2 * plane, left, inside(g_vxy));
        });
    }
    args.sums[3 * band] = sum(total), args.sums[3 * band + 1] = sum(apart), args.sums[3 * band + 2] = sum(squared);
}

// Filters the maps back: the window is symmetric, so the adjoint of the filter is the filter.
template <class R>
static void ssim_gradient(const SsimArgs<R>& args, int64_t begin, int64_t end, R* scratch) {
    using V = Abreast<R>;
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    std::memset(scratch, 0, sizeof(R) * size_t(3 * stride));
    const V zero = abreast(R(0)), similarity = abreast(args.similarity), absolute = abreast(args.absolute), squared = abreast(R(2) * args.squared);
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kRadius ? -y : -kRadius, bottom = args.height - 1 - y < kRadius ? args.height - 1 - y : kRadius;
        along<R>(reached(args.pulled[y], length), [&](int64_t x, int64_t left, auto whole) {
            V sums[3] = {zero, zero, zero};
            for (int64_t k = top; k <= bottom; k++) {
                const V tap = abreast(R(kTaps[k < 0 ? -k : k]));
                for (int m = 0; m < 3; m++) sums[m] = fma(tap, take<whole>(args.maps + m * plane + (y + k) * length + x, left), sums[m]);
            }
            for (int m = 0; m < 3; m++) put<whole>(scratch + m * stride + kPad + x, left, sums[m]);
        });
        along<R>(args.pulled[y], [&](int64_t x, int64_t left, auto whole) {
            const R* in = scratch + kPad + x;
            const int64_t at = y * args.row + x;
            const V image = take<whole>(args.image + at, left), target = take<whole>(args.target + at, left);
            const V g = fma(abreast(R(2)) * image, across(in + stride), fma(target, across(in + 2 * stride), across(in)));
            const V sign = select(target < image, absolute, select(image < target, zero - absolute, zero));
            put<whole>(args.gradient + at, left, fma(similarity, g, fma(squared, image - target, sign)));
        });
    }
}

}  // namespace graings::GRAINGS_ISA
