// Sigmoid and tanh, and colours from the outputs of their networks. Computed in float64 and rounded once: the values do
// not depend on their position in an array.
#pragma once
#include "exponentials.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kActivated = 16;  // numbers at a time

// NaN passes.
template <class R, int N> GRAINGS_INLINE Vec<R, N> sigmoid(Vec<double, N> x) {
    const auto one = splat<double, N>(1);
    return rounded<R>(select(x <= x, one / (one + exp<R>(-x)), x));
}

// Within 3e-16 of the exact value before rounding to R; zero at zero. NaN passes.
template <class R, int N> GRAINGS_INLINE Vec<R, N> tanh(Vec<double, N> x) {
    const auto one = splat<double, N>(1);
    return rounded<R>(select(x <= x, one - splat<double, N>(2) / (exp<double>(x + x) + one), x));
}

// Calls body(begin, load, store) for groups of kActivated numbers. load(p) is a group at p + begin, store(p, x) its
// opposite; in the last group both are limited to `count` numbers.
template <class R, class Body>
GRAINGS_INLINE void in_groups(int64_t count, Body body) {
    constexpr int N = kActivated;
    int64_t begin = 0;
    for (; begin + N <= count; begin += N)
        body([&](const R* p) { return load_as<N>(p + begin); }, [&](R* p, Vec<R, N> x) { store(p + begin, x); });
    const size_t rest = sizeof(R) * size_t(count - begin);
    if (!rest) return;
    R numbers[N] = {};
    body(
        [&](const R* p) {
            std::memcpy(numbers, p + begin, rest);
            return load_as<N>(static_cast<const R*>(numbers));
        },
        [&](R* p, Vec<R, N> x) {
            store(numbers, x);
            std::memcpy(p + begin, numbers, rest);
        });
}

template <class R>
static void activate(Activation kind, int64_t count, const R* x, R* out) {
    if (kind == kSigmoid) in_groups<R>(count, [&](auto load, auto store) { store(out, sigmoid<R>(load(x))); });
    else in_groups<R>(count, [&](auto load, auto store) { store(out, tanh<R>(load(x))); });
}

// out = v times the derivative of the activation at x: s^2 E / (1 + E)^2 with E = exp(-s |x|), s = 2 for tanh, which is
// positive where the value saturates. NaN passes.
template <class R, int N> GRAINGS_INLINE Vec<R, N> activated_gradient(double s, Vec<double, N> x, Vec<double, N> v) {
    const auto one = splat<double, N>(1), argument = splat<double, N>(-s) * abs(x), lowest = splat<double, N>(-708);
    const auto e = select(argument < lowest, splat<double, N>(0), exp<double>(argument)), sum = one + e;
    return rounded<R>(select(x <= x, v * splat<double, N>(s * s) * e / (sum * sum), x));
}

template <class R>
static void activate_gradient(Activation kind, int64_t count, const R* x, const R* v, R* out) {
    const double s = kind == kSigmoid ? 1 : 2;
    in_groups<R>(count, [&](auto load, auto store) {
        const auto at = load(x);
        store(out, activated_gradient<R>(s, at, load(v)));
    });
}

// Eq. 11 to 13: colors = sigmoid(colors), then clip(colors + bound tanh(residual)) where there is a residual.
template <class R>
static void finish_colors(int64_t count, R bound, const R* residual, R* colors) {
    constexpr int N = kActivated;
    if (!residual) return activate(kSigmoid, count, colors, colors);
    const auto zero = splat<R, N>(R(0)), one = splat<R, N>(R(1)), scale = splat<R, N>(bound);
    in_groups<R>(count, [&](auto load, auto store) {
        const auto canonical = sigmoid<R>(load(colors));
        const auto color = canonical + scale * tanh<R>(load(residual));
        store(colors, select(color < zero, zero, select(one < color, one, color)));
    });
}

}  // namespace graings::GRAINGS_ISA
