// Vectors of N numbers, built from the registers of the instruction set that this file is compiled for.
// Everything is in the namespace of that instruction set and inlined, so that the linker cannot use a symbol compiled
// for a newer CPU on an older one. Products and sums are fused only by explicit `fma`.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#ifndef GRAINGS_ISA
#error "compile through CMake: GRAINGS_ISA names the instruction set"
#endif
#define GRAINGS_INLINE static inline __attribute__((always_inline))

namespace graings::GRAINGS_ISA {

#if defined(__AVX512F__)
constexpr int kBytes = 64;
#elif defined(__AVX2__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 16;
#endif

template <class T> struct Bits;
template <> struct Bits<float> { using type = int32_t; };
template <> struct Bits<double> { using type = int64_t; };

template <class T> constexpr int kNative = kBytes / static_cast<int>(sizeof(T));
template <class T> struct NativeOf { typedef T type __attribute__((vector_size(kBytes))); };
template <class T> using Native = typename NativeOf<T>::type;
template <class T> using NativeBits = typename NativeOf<typename Bits<T>::type>::type;

// ---- one register
#if defined(__AVX512F__)
template <class T> using NativeMask = std::conditional_t<sizeof(T) == 4, __mmask16, __mmask8>;
GRAINGS_INLINE __mmask16 less(Native<float> a, Native<float> b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
GRAINGS_INLINE __mmask8 less(Native<double> a, Native<double> b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ); }
GRAINGS_INLINE __mmask16 less_equal(Native<float> a, Native<float> b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
GRAINGS_INLINE __mmask8 less_equal(Native<double> a, Native<double> b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LE_OQ); }
GRAINGS_INLINE Native<float> choose(__mmask16 m, Native<float> a, Native<float> b) { return (Native<float>)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
GRAINGS_INLINE Native<double> choose(__mmask8 m, Native<double> a, Native<double> b) { return (Native<double>)_mm512_mask_blend_pd(m, (__m512d)b, (__m512d)a); }
GRAINGS_INLINE bool any_lane(__mmask16 m) { return m != 0; }
GRAINGS_INLINE bool any_lane(__mmask8 m) { return m != 0; }
GRAINGS_INLINE uint32_t bits_of(__mmask16 m) { return m; }
GRAINGS_INLINE uint32_t bits_of(__mmask8 m) { return m; }
GRAINGS_INLINE Native<float> fused(Native<float> a, Native<float> b, Native<float> c) { return (Native<float>)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
GRAINGS_INLINE Native<double> fused(Native<double> a, Native<double> b, Native<double> c) { return (Native<double>)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
GRAINGS_INLINE Native<float> minimum(Native<float> a, Native<float> b) { return (Native<float>)_mm512_min_ps((__m512)a, (__m512)b); }
GRAINGS_INLINE Native<double> minimum(Native<double> a, Native<double> b) { return (Native<double>)_mm512_min_pd((__m512d)a, (__m512d)b); }
GRAINGS_INLINE Native<float> maximum(Native<float> a, Native<float> b) { return (Native<float>)_mm512_max_ps((__m512)a, (__m512)b); }
GRAINGS_INLINE Native<double> maximum(Native<double> a, Native<double> b) { return (Native<double>)_mm512_max_pd((__m512d)a, (__m512d)b); }
GRAINGS_INLINE Native<double> root(Native<double> a) { return (Native<double>)_mm512_sqrt_pd((__m512d)a); }
GRAINGS_INLINE Native<float> concatenated(Native<double> lo, Native<double> hi) {
    return (Native<float>)_mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps((__m512d)lo)), _mm512_cvtpd_ps((__m512d)hi), 1);
}
#else
template <class T> using NativeMask = NativeBits<T>;
GRAINGS_INLINE Native<float> concatenated(Native<double> lo, Native<double> hi) {
#if defined(__AVX2__)
    return (Native<float>)_mm256_set_m128(_mm256_cvtpd_ps((__m256d)hi), _mm256_cvtpd_ps((__m256d)lo));
#else
    Native<float> both{};
    for (int i = 0; i < 2; i++) both[i] = float(lo[i]), both[i + 2] = float(hi[i]);
    return both;
#endif
}
template <class V> GRAINGS_INLINE auto less(V a, V b) { return a < b; }
template <class V> GRAINGS_INLINE auto less_equal(V a, V b) { return a <= b; }
template <class M, class V> GRAINGS_INLINE V choose(M m, V a, V b) { return m ? a : b; }
template <class M> GRAINGS_INLINE uint32_t bits_of(M m) {
#if defined(__AVX2__)
    if constexpr (sizeof(m[0]) == 4) return uint32_t(_mm256_movemask_ps((__m256)m));
    else return uint32_t(_mm256_movemask_pd((__m256d)m));
#elif defined(__x86_64__)
    if constexpr (sizeof(m[0]) == 4) return uint32_t(_mm_movemask_ps((__m128)m));
    else return uint32_t(_mm_movemask_pd((__m128d)m));
#endif
    uint32_t bits = 0;
    for (int i = 0; i < static_cast<int>(sizeof(M) / sizeof(m[0])); i++) bits |= uint32_t(m[i] != 0) << i;
    return bits;
}
template <class M> GRAINGS_INLINE bool any_lane(M m) {
#if defined(__x86_64__)
    return bits_of(m) != 0;
#elif defined(__aarch64__)
    return vmaxvq_u32((uint32x4_t)m) != 0;
#endif
    bool any = false;
    for (int i = 0; i < static_cast<int>(sizeof(M) / sizeof(m[0])); i++) any |= m[i] != 0;
    return any;
}
#if defined(__AVX2__)
// a < b ? a : b and a > b ? a : b in one instruction, which the compiler does not always emit.
GRAINGS_INLINE Native<float> minimum(Native<float> a, Native<float> b) { return (Native<float>)_mm256_min_ps((__m256)a, (__m256)b); }
GRAINGS_INLINE Native<double> minimum(Native<double> a, Native<double> b) { return (Native<double>)_mm256_min_pd((__m256d)a, (__m256d)b); }
GRAINGS_INLINE Native<float> maximum(Native<float> a, Native<float> b) { return (Native<float>)_mm256_max_ps((__m256)a, (__m256)b); }
GRAINGS_INLINE Native<double> maximum(Native<double> a, Native<double> b) { return (Native<double>)_mm256_max_pd((__m256d)a, (__m256d)b); }
#else
template <class V> GRAINGS_INLINE V minimum(V a, V b) { return a < b ? a : b; }
template <class V> GRAINGS_INLINE V maximum(V a, V b) { return a > b ? a : b; }
#endif
#if defined(__AVX2__)
GRAINGS_INLINE Native<float> fused(Native<float> a, Native<float> b, Native<float> c) { return (Native<float>)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
GRAINGS_INLINE Native<double> fused(Native<double> a, Native<double> b, Native<double> c) { return (Native<double>)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
GRAINGS_INLINE Native<double> root(Native<double> a) { return (Native<double>)_mm256_sqrt_pd((__m256d)a); }
#elif defined(__aarch64__)
GRAINGS_INLINE Native<float> fused(Native<float> a, Native<float> b, Native<float> c) { return (Native<float>)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
GRAINGS_INLINE Native<double> fused(Native<double> a, Native<double> b, Native<double> c) { return (Native<double>)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
GRAINGS_INLINE Native<double> root(Native<double> a) { return (Native<double>)vsqrtq_f64((float64x2_t)a); }
#else
template <class V> GRAINGS_INLINE V fused(V a, V b, V c) { return a * b + c; }
GRAINGS_INLINE Native<double> root(Native<double> a) {
    for (int i = 0; i < kNative<double>; i++) a[i] = __builtin_sqrt(a[i]);
    return a;
}
#endif
#endif

// ---- one number
GRAINGS_INLINE double fused(double a, double b, double c) {
#if defined(__FMA__) || defined(__aarch64__)
    return __builtin_fma(a, b, c);
#else
    return a * b + c;
#endif
}

// ---- N numbers: one register, or two halves
template <class T, int N, bool One = (N == kNative<T>)> struct Vec;
template <class T, int N, bool One = (N == kNative<T>)> struct Mask;
template <class T, int N> struct Vec<T, N, true> { Native<T> v; };
template <class T, int N> struct Mask<T, N, true> { NativeMask<T> v; };
template <class T, int N> struct Vec<T, N, false> {
    static_assert(N > kNative<T>, "narrower than a register");
    Vec<T, N / 2> lo, hi;
};
template <class T, int N> struct Mask<T, N, false> { Mask<T, N / 2> lo, hi; };

template <class T, int N> constexpr bool kOne = N == kNative<T>;

#define GRAINGS_VEC template <class T, int N> GRAINGS_INLINE
#define GRAINGS_BINARY(name, expression)                                     \
    GRAINGS_VEC Vec<T, N> name(Vec<T, N> a, Vec<T, N> b) {                   \
        if constexpr (kOne<T, N>) return {expression};                       \
        else return {name(a.lo, b.lo), name(a.hi, b.hi)};                    \
    }
GRAINGS_BINARY(operator+, a.v + b.v)
GRAINGS_BINARY(operator-, a.v - b.v)
GRAINGS_BINARY(operator*, a.v* b.v)
GRAINGS_BINARY(operator/, a.v / b.v)
GRAINGS_BINARY(min, minimum(a.v, b.v))
GRAINGS_BINARY(max, maximum(a.v, b.v))
#undef GRAINGS_BINARY
GRAINGS_VEC Vec<T, N> splat(T x) {
    if constexpr (kOne<T, N>) { return {x - Native<T>{}}; }
    else { auto h = splat<T, N / 2>(x); return {h, h}; }
}
GRAINGS_VEC Vec<T, N> operator-(Vec<T, N> a) { return splat<T, N>(T(0)) - a; }
GRAINGS_VEC Vec<T, N> operator*(T a, Vec<T, N> b) { return splat<T, N>(a) * b; }
GRAINGS_VEC Vec<T, N> fma(Vec<T, N> a, Vec<T, N> b, Vec<T, N> c) {
    if constexpr (kOne<T, N>) return {fused(a.v, b.v, c.v)};
    else return {fma(a.lo, b.lo, c.lo), fma(a.hi, b.hi, c.hi)};
}
// c - a * b
GRAINGS_VEC Vec<T, N> fnma(Vec<T, N> a, Vec<T, N> b, Vec<T, N> c) {
    if constexpr (kOne<T, N>) return {fused(-a.v, b.v, c.v)};
    else return {fnma(a.lo, b.lo, c.lo), fnma(a.hi, b.hi, c.hi)};
}
GRAINGS_VEC Vec<T, N> sqrt(Vec<T, N> a) {
    if constexpr (kOne<T, N>) return {root(a.v)};
    else return {sqrt(a.lo), sqrt(a.hi)};
}
template <int N, class T> GRAINGS_INLINE Vec<T, N> load(const T* p) {
    if constexpr (kOne<T, N>) { Vec<T, N> r; std::memcpy(&r.v, p, sizeof r.v); return r; }
    else return {load<N / 2>(p), load<N / 2>(p + N / 2)};
}
GRAINGS_VEC void store(T* p, Vec<T, N> a) {
    if constexpr (kOne<T, N>) std::memcpy(p, &a.v, sizeof a.v);
    else { store(p, a.lo); store(p + N / 2, a.hi); }
}
GRAINGS_VEC Mask<T, N> operator<(Vec<T, N> a, Vec<T, N> b) {
    if constexpr (kOne<T, N>) return {static_cast<NativeMask<T>>(less(a.v, b.v))};
    else return {a.lo < b.lo, a.hi < b.hi};
}
GRAINGS_VEC Mask<T, N> operator<=(Vec<T, N> a, Vec<T, N> b) {
    if constexpr (kOne<T, N>) return {static_cast<NativeMask<T>>(less_equal(a.v, b.v))};
    else return {a.lo <= b.lo, a.hi <= b.hi};
}
GRAINGS_VEC Vec<T, N> select(Mask<T, N> m, Vec<T, N> a, Vec<T, N> b) {
    if constexpr (kOne<T, N>) return {choose(m.v, a.v, b.v)};
    else return {select(m.lo, a.lo, b.lo), select(m.hi, a.hi, b.hi)};
}
GRAINGS_VEC bool any(Mask<T, N> m) {
    if constexpr (kOne<T, N>) return any_lane(m.v);
    else return any(m.lo | m.hi);
}
// One bit per number, the first lowest.
GRAINGS_VEC uint32_t bits(Mask<T, N> m) {
    if constexpr (kOne<T, N>) return bits_of(m.v);
    else return bits(m.lo) | bits(m.hi) << (N / 2);
}
GRAINGS_VEC Vec<T, N> abs(Vec<T, N> a) {
    if constexpr (kOne<T, N>) {
        constexpr auto magnitude = static_cast<typename Bits<T>::type>(~(1ull << (8 * sizeof(T) - 1)));
        return {(Native<T>)((NativeBits<T>)a.v & magnitude)};
    } else return {abs(a.lo), abs(a.hi)};
}
GRAINGS_VEC Mask<T, N> operator&(Mask<T, N> a, Mask<T, N> b) {
    if constexpr (kOne<T, N>) return {static_cast<NativeMask<T>>(a.v & b.v)};
    else return {a.lo & b.lo, a.hi & b.hi};
}
GRAINGS_VEC Mask<T, N> operator|(Mask<T, N> a, Mask<T, N> b) {
    if constexpr (kOne<T, N>) return {static_cast<NativeMask<T>>(a.v | b.v)};
    else return {a.lo | b.lo, a.hi | b.hi};
}
// Rounded to R and stored.
template <class R, int N> GRAINGS_INLINE void store_as(R* p, Vec<double, N> a) {
    if constexpr (sizeof(R) == sizeof(double)) store(p, a);
    else if constexpr (kOne<double, N>) {
        typedef float Half __attribute__((vector_size(kBytes / 2)));
        const Half rounded = __builtin_convertvector(a.v, Half);
        std::memcpy(p, &rounded, sizeof rounded);
    } else { store_as<R>(p, a.lo); store_as<R>(p + N / 2, a.hi); }
}
// Rounded to R.
template <class R, int N> GRAINGS_INLINE Vec<R, N> rounded(Vec<double, N> a) {
    if constexpr (sizeof(R) == sizeof(double)) return a;
    else if constexpr (kOne<R, N>) return {concatenated(a.lo.v, a.hi.v)};
    else return {rounded<R>(a.lo), rounded<R>(a.hi)};
}
// N numbers of R, widened.
template <int N, class R> GRAINGS_INLINE Vec<double, N> load_as(const R* p) {
    if constexpr (sizeof(R) == sizeof(double)) return load<N>(p);
#if defined(__AVX512F__)
    else if constexpr (kOne<double, N>) return {(Native<double>)_mm512_cvtps_pd(_mm256_loadu_ps(p))};
#elif defined(__AVX2__)
    else if constexpr (kOne<double, N>) return {(Native<double>)_mm256_cvtps_pd(_mm_loadu_ps(p))};
#endif
    else if constexpr (kOne<double, N>) {
        typedef float Half __attribute__((vector_size(kBytes / 2)));
        Half narrow;
        std::memcpy(&narrow, p, sizeof narrow);
        return {__builtin_convertvector(narrow, Native<double>)};
    } else return {load_as<N / 2>(p), load_as<N / 2>(p + N / 2)};
}
GRAINGS_VEC T sum(Vec<T, N> a) {
    if constexpr (kOne<T, N>) {
        T sums[N];
        store(sums, a);
        for (int step = N / 2; step > 0; step /= 2)
            for (int i = 0; i < step; i++) sums[i] += sums[i + step];
        return sums[0];
    } else return sum(a.lo + a.hi);
}
GRAINGS_VEC Vec<T, N> clamp(Vec<T, N> x, Vec<T, N> low, Vec<T, N> high) { return min(max(x, low), high); }
// p * 2^n, where `shifted` = n + 1.5 * 2^mantissa holds the integer n in its low bits
GRAINGS_VEC Vec<T, N> scale_by_power(Vec<T, N> p, Vec<T, N> shifted) {
    if constexpr (kOne<T, N>) {
        constexpr int mantissa = sizeof(T) == 4 ? 23 : 52;
        return {(Native<T>)((NativeBits<T>)p.v + ((NativeBits<T>)shifted.v << mantissa))};
    } else return {scale_by_power(p.lo, shifted.lo), scale_by_power(p.hi, shifted.hi)};
}

// ---- exponentials
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
GRAINGS_VEC Vec<T, N> exp2(Vec<T, N> x) {
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
// floor(x) for |x| < 2^51
GRAINGS_VEC Vec<T, N> floor(Vec<T, N> x) {
    static_assert(sizeof(T) == 8);
    if constexpr (kOne<T, N>) {
#if defined(__AVX512F__)
        return {(Native<T>)_mm512_roundscale_pd((__m512d)x.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};
#elif defined(__AVX2__)
        return {(Native<T>)_mm256_floor_pd((__m256d)x.v)};
#else
        constexpr T magic = 6755399441055744;
        const Native<T> nearest = (x.v + magic) - magic;
        return {nearest - choose(less(x.v, nearest), Native<T>{} + T(1), Native<T>{})};
#endif
    } else return {floor(x.lo), floor(x.hi)};
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
#undef GRAINGS_VEC

}  // namespace graings::GRAINGS_ISA
