// Structural similarity in the 3DGS definition (11x11 Gaussian window, sigma 1.5, zero padding, per channel), the
// absolute and the squared difference, and the gradient of a mixture of the three with respect to the first image. Rows
// are independent: any split over threads gives the same bits.
#pragma once
#include <type_traits>

#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kPad = 3 * kSsimRadius;  // a neighbouring pixel is three numbers away

// One register of numbers at a time, so that the sums over a window stay in registers on every instruction set.
template <class R> constexpr int kRegisterWidth = kNative<R>;
template <class R> using Register = Vec<R, kRegisterWidth<R>>;
template <class R> GRAINGS_INLINE Register<R> broadcast(R x) { return splat<R, kRegisterWidth<R>>(x); }

// Loads a register of which `left` numbers are inside the row; if not Whole, zeros follow.
template <bool Whole, class R>
GRAINGS_INLINE Register<R> take(const R* p, int64_t left) {
    if constexpr (Whole) return load<kRegisterWidth<R>>(p);
    R lanes[kRegisterWidth<R>] = {};
    std::memcpy(lanes, p, sizeof(R) * size_t(left));
    return load<kRegisterWidth<R>>(lanes);
}
template <bool Whole, class R>
GRAINGS_INLINE void put(R* p, int64_t left, Register<R> value) {
    if constexpr (Whole) return store(p, value);
    R lanes[kRegisterWidth<R>];
    store(lanes, value);
    std::memcpy(p, lanes, sizeof(R) * size_t(left));
}
// Calls each(x, numbers left, whole register) for a range of a row, a register at a time.
template <class R, class Each>
GRAINGS_INLINE void each_register(Range part, Each each) {
    int64_t x = part.begin;
    for (; x + kRegisterWidth<R> <= part.end; x += kRegisterWidth<R>) each(x, part.end - x, std::true_type());
    if (x < part.end) each(x, part.end - x, std::false_type());
}
// The range widened by the window's radius, within a row of `length` numbers.
GRAINGS_INLINE Range widened(Range part, int64_t length) {
    if (part.begin >= part.end) return part;
    return {part.begin < kPad ? 0 : part.begin - kPad, part.end + kPad > length ? length : part.end + kPad};
}

// Row length of the scratch memory, with zeros on both sides so that the horizontal filter needs no bounds checks.
GRAINGS_INLINE int64_t padded(int64_t width) { return 3 * width + 2 * kPad + 2 * kLanes; }

template <class R>
GRAINGS_INLINE Register<R> filter_row(const R* row) {
    Register<R> sum = broadcast(R(0));
    for (int k = -kSsimRadius; k <= kSsimRadius; k++) sum = fma(load<kRegisterWidth<R>>(row + 3 * k), broadcast(R(kSsimTaps[k < 0 ? -k : k])), sum);
    return sum;
}

// The measures of rows [begin, end), summed into sums[3 * band]; if `maps` is given, writes the maps for the gradient.
template <class R>
static void ssim_values(const SsimArgs<R>& args, int64_t band, int64_t begin, int64_t end, R* scratch) {
    using V = Register<R>;
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    const R c1 = R(kSsimC1), c2 = R(kSsimC2);
    const V zero = broadcast(R(0)), one = broadcast(R(1)), two = broadcast(R(2));
    std::memset(scratch, 0, sizeof(R) * size_t(5 * stride));
    auto total = splat<double, kRegisterWidth<R>>(0), absolute = total, squared = total;
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kSsimRadius ? -y : -kSsimRadius, bottom = args.height - 1 - y < kSsimRadius ? args.height - 1 - y : kSsimRadius;
        each_register<R>(widened(args.windows[y], length), [&](int64_t x, int64_t left, auto whole) {
            V sx = zero, sy = zero, sxx = zero, syy = zero, sxy = zero;
            for (int64_t k = top; k <= bottom; k++) {
                const V tap = broadcast(R(kSsimTaps[k < 0 ? -k : k]));
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
        each_register<R>(args.windows[y], [&](int64_t x, int64_t left, auto whole) {
            const R* in = scratch + kPad + x;
            const V mx = filter_row(in), my = filter_row(in + stride);
            const V vx = filter_row(in + 2 * stride) - mx * mx, vy = max(filter_row(in + 3 * stride) - my * my, zero);
            const V vxy = filter_row(in + 4 * stride) - mx * my;
            const V a1 = fma(two * mx, my, broadcast(c1)), a2 = fma(two, vxy, broadcast(c2));
            const V b1 = fma(mx, mx, fma(my, my, broadcast(c1))), b2 = max(vx, zero) + vy + broadcast(c2);
            const V inverse = one / (b1 * b2), raw = a1 * a2 * inverse;
            const V difference = take<whole>(args.image + y * args.row + x, left) - take<whole>(args.target + y * args.row + x, left);
            R lanes[kRegisterWidth<R>], differences[kRegisterWidth<R>];
            store(lanes, clamp(raw, zero - one, one)), store(differences, max(difference, zero - difference));
            for (int64_t i = left; !whole && i < kRegisterWidth<R>; i++) lanes[i] = 0;
            const auto distance = load_as<kRegisterWidth<R>>(differences);
            total = total + load_as<kRegisterWidth<R>>(lanes), absolute = absolute + distance, squared = fma(distance, distance, squared);
            if (!args.maps) return;
            const auto inside = [&](V value) { return select(raw <= one, select(zero - one <= raw, value, zero), zero); };
            const V g_vxy = two * a1 * inverse;
            const V g_vx = select(zero <= vx, zero - raw * b1 * inverse, zero);
            const V g_mx = two * (my * a2 * inverse - raw * mx * b2 * inverse) - g_vxy * my - two * g_vx * mx;
            R* map = args.maps + y * length + x;
            put<whole>(map, left, inside(g_mx)), put<whole>(map + plane, left, inside(g_vx)), put<whole>(map + 2 * plane, left, inside(g_vxy));
        });
    }
    args.sums[3 * band] = sum(total), args.sums[3 * band + 1] = sum(absolute), args.sums[3 * band + 2] = sum(squared);
}

// The adjoint: the window is symmetric, so the adjoint of the filter is the filter.
template <class R>
static void ssim_gradient(const SsimArgs<R>& args, int64_t begin, int64_t end, R* scratch) {
    using V = Register<R>;
    const int64_t length = 3 * args.width, stride = padded(args.width), plane = args.height * length;
    std::memset(scratch, 0, sizeof(R) * size_t(3 * stride));
    const V zero = broadcast(R(0)), similarity = broadcast(args.similarity), absolute = broadcast(args.absolute), squared = broadcast(R(2) * args.squared);
    for (int64_t y = begin; y < end; y++) {
        const int64_t top = y < kSsimRadius ? -y : -kSsimRadius, bottom = args.height - 1 - y < kSsimRadius ? args.height - 1 - y : kSsimRadius;
        each_register<R>(widened(args.affected[y], length), [&](int64_t x, int64_t left, auto whole) {
            V sums[3] = {zero, zero, zero};
            for (int64_t k = top; k <= bottom; k++) {
                const V tap = broadcast(R(kSsimTaps[k < 0 ? -k : k]));
                for (int m = 0; m < 3; m++) sums[m] = fma(tap, take<whole>(args.maps + m * plane + (y + k) * length + x, left), sums[m]);
            }
            for (int m = 0; m < 3; m++) put<whole>(scratch + m * stride + kPad + x, left, sums[m]);
        });
        each_register<R>(args.affected[y], [&](int64_t x, int64_t left, auto whole) {
            const R* in = scratch + kPad + x;
            const int64_t at = y * args.row + x;
            const V image = take<whole>(args.image + at, left), target = take<whole>(args.target + at, left);
            const V g = fma(broadcast(R(2)) * image, filter_row(in + stride), fma(target, filter_row(in + 2 * stride), filter_row(in)));
            const V sign = select(target < image, absolute, select(image < target, zero - absolute, zero));
            put<whole>(args.gradient + at, left, fma(similarity, g, fma(squared, image - target, sign)));
        });
    }
}

}  // namespace graings::GRAINGS_ISA
