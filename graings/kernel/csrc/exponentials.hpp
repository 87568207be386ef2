// Exponentials and logarithms of vectors, with the error that their comments state.
#pragma once
#include "simd.hpp"

namespace graings::GRAINGS_ISA {

// p * 2^n, where `shifted` = n + 1.5 * 2^mantissa holds the integer n in its low bits
template <class T, int N> GRAINGS_INLINE Vec<T, N> scale_by_power(Vec<T, N> p, Vec<T, N> shifted) {
    if constexpr (kOne<T, N>) {
        constexpr int mantissa = sizeof(T) == 4 ? 23 : 52;
        return {(Native<T>)((NativeBits<T>)p.v + ((NativeBits<T>)shifted.v << mantissa))};
    } else return {scale_by_power(p.lo, shifted.lo), scale_by_power(p.hi, shifted.hi)};
}
// c[0] x^(K - 1) + ... + c[K - 1]
template <class T, int N, int K> GRAINGS_INLINE Vec<T, N> polynomial(Vec<T, N> x, const T (&c)[K]) {
    auto p = splat<T, N>(c[0]);
    for (int k = 1; k < K; k++) p = fma(p, x, splat<T, N>(c[k]));
    return p;
}
template <int N> GRAINGS_INLINE Vec<float, N> power_of_two_part(Vec<float, N> f) {
    // Minimax on [-1/2, 1/2] with the constant term fixed at 1: 9.2e-8 before rounding, 1.7e-7 after.
    constexpr float c[] = {1.32647272e-3f, 9.67151264e-3f, 5.55073374e-2f, 2.40222421e-1f, 6.93146978e-1f, 1.0f};
    return polynomial(f, c);
}
template <int N> GRAINGS_INLINE Vec<double, N> power_of_two_part(Vec<double, N> f) {
    // Taylor coefficients ln(2)^k / k!: the remainder on [-1/2, 1/2] is 4e-18.
    constexpr double c[] = {1.3691488853904124e-12, 2.5678435993488196e-11, 4.44553827187081e-10, 7.054911620801121e-09,
                            1.0178086009239696e-07, 1.3215486790144305e-06, 1.5252733804059838e-05, 1.5403530393381606e-04,
                            1.3333558146428441e-03, 9.618129107628477e-03, 5.5504108664821576e-02, 0.2402265069591007,
                            0.6931471805599453, 1.0};
    return polynomial(f, c);
}
// 2^x for x up to about 1; inexact below 2^-125 (2^-1021 in double), far below any visible contribution.
template <class T, int N> GRAINGS_INLINE Vec<T, N> exp2(Vec<T, N> x) {
#if defined(__AVX512F__)
    if constexpr (sizeof(T) == 4 && kOne<T, N>) {
        // The fraction x - floor(x); scalef uses floor(x) itself. Minimax on [0, 1) with the constant term fixed at 1:
        // 8.3e-8 before rounding, 1.5e-7 after.
        const Vec<T, N> f{(Native<T>)_mm512_reduce_ps((__m512)x.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};
        constexpr float c[] = {1.86713007e-3f, 9.01703032e-3f, 5.57999131e-2f, 2.4016445e-1f, 6.93151312e-1f, 1.0f};
        return {(Native<T>)_mm512_scalef_ps((__m512)polynomial(f, c).v, (__m512)x.v)};
    }
#endif
    constexpr T magic = sizeof(T) == 4 ? T(12582912) : T(6755399441055744);
    constexpr T limit = sizeof(T) == 4 ? T(-125) : T(-1021);
    x = max(x, splat<T, N>(limit));
    auto shifted = splat<T, N>(magic) + x;
    auto f = x - (shifted - splat<T, N>(magic));
    return scale_by_power(power_of_two_part(f), shifted);
}
// e^x, with x limited to [-708, 709]; for R = float to 6e-11, below its precision
template <class R, int N> GRAINGS_INLINE Vec<double, N> exp(Vec<double, N> x) {
    constexpr double magic = 6755399441055744;
    x = clamp(x, splat<double, N>(-708), splat<double, N>(709));
    auto shifted = fma(x, splat<double, N>(1.4426950408889634), splat<double, N>(magic));
    auto n = shifted - splat<double, N>(magic);
    auto f = fma(n, splat<double, N>(-6.93147180369123816490e-01), x);
    f = fma(n, splat<double, N>(-1.90821492927058770002e-10), f);
    if constexpr (sizeof(R) == 4) {  // minimax with the first two terms fixed
        constexpr double c[] = {1.9790352363448812e-04, 1.3944648662873452e-03, 8.333497008487295e-03, 4.166629509252087e-02,
                                0.16666665869415376, 0.5000000067642875, 1.0, 1.0};
        return scale_by_power(polynomial(f, c), shifted);
    }
    constexpr double c[] = {1.6059043836821613e-10, 2.08767569878681e-09, 2.505210838544172e-08, 2.755731922398589e-07,
                            2.7557319223985893e-06, 2.48015873015873e-05, 1.984126984126984e-04, 1.388888888888889e-03,
                            8.333333333333333e-03, 4.1666666666666664e-02, 0.16666666666666666, 0.5, 1.0, 1.0};
    return scale_by_power(polynomial(f, c), shifted);
}
// x = fraction * 2^power with the fraction in [sqrt(1/2), sqrt(2)), for positive normal numbers
template <int N> GRAINGS_INLINE void split_power(Vec<double, N> x, Vec<double, N>& power, Vec<double, N>& fraction) {
    if constexpr (kOne<double, N>) {
        typedef NativeBits<double> I;
        const I bits = (I)x.v, above = (bits & 0xFFFFFFFFFFFFF) > 0x6A09E667F3BCC ? I{} + 1 : I{};  // of the fraction in [1, 2)
        constexpr double magic = 6755399441055744;  // 1.5 * 2^52: conversion by addition, because few CPUs convert 64-bit integers
        power.v = (Native<double>)((bits >> 52) - 1023 + above + (I)(Native<double>{} + magic)) - magic;
        fraction.v = (Native<double>)((bits & 0xFFFFFFFFFFFFF) | ((I{} + 1023 - above) << 52));
    } else {
        split_power(x.lo, power.lo, fraction.lo);
        split_power(x.hi, power.hi, fraction.hi);
    }
}
// log2 of positive normal numbers, to 2e-16 relative to max(1, |result|); for R = float to 2e-12
template <class R, int N> GRAINGS_INLINE Vec<double, N> log2(Vec<double, N> x) {
    Vec<double, N> power, fraction;
    split_power(x, power, fraction);  // fraction in [sqrt(1/2), sqrt(2))
    const auto one = splat<double, N>(1);
    const auto s = (fraction - one) / (fraction + one), q = s * s;
    // 2 / ln 2 * atanh(s) with |s| <= 0.1716
    if constexpr (sizeof(R) == 4) {
        constexpr double c[] = {0.3427913402208697, 0.41153628116551366, 0.5770865938479515, 0.9617966487926921, 2.885390081843991};
        return fma(polynomial(q, c), s, power);
    }
    constexpr double c[] = {0.1373995277037108, 0.15186263588304877, 0.16972882833987804, 0.19235933878519512, 0.22195308321368667, 0.2623081892525388,
                            0.3205988979753252, 0.4121985831111324,  0.5770780163555853,  0.9617966939259756,  2.8853900817779268};
    return fma(polynomial(q, c), s, power);
}

}  // namespace graings::GRAINGS_ISA
