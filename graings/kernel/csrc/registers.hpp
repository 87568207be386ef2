// One register of the instruction set that this file is compiled for.
// Everything is in the namespace of that instruction set and inlined, so that the linker cannot use a symbol compiled
// for a newer CPU on an older one. Products and sums are fused only by explicit `fma`.
#pragma once
#include <cstdint>
#include <type_traits>
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

// One number.
GRAINGS_INLINE double fused(double a, double b, double c) {
#if defined(__FMA__) || defined(__aarch64__)
    return __builtin_fma(a, b, c);
#else
    return a * b + c;
#endif
}

}  // namespace graings::GRAINGS_ISA
