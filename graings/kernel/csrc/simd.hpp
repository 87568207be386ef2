// Vectors of N numbers: one register, or two halves.
#pragma once
#include <cstring>

#include "registers.hpp"

namespace graings::GRAINGS_ISA {

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
#undef GRAINGS_VEC

}  // namespace graings::GRAINGS_ISA
