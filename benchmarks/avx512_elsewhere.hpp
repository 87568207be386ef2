// The AVX-512 intrinsics that the kernel calls, for a CPU with AVX2. Most come from SIMDe; those that SIMDe 0.7 lacks or
// implements incorrectly are written here, element by element. A register is a vector of 64 bytes that GCC splits.
#pragma once
#include <cstring>
#include <immintrin.h>
#include <simde/x86/avx512.h>

namespace elsewhere {

template <class To, class From> static inline To same_bits(const From& from) {
    static_assert(sizeof(To) == sizeof(From));
    To to;
    std::memcpy(&to, &from, sizeof(To));
    return to;
}

template <class To, class From, class Of> static inline To each(const From& from, const Of& of) {
    constexpr int count = sizeof(From) / sizeof(from[0]);
    decltype(of(from[0])) numbers[count];
    for (int i = 0; i < count; i++) numbers[i] = of(from[i]);
    return same_bits<To>(numbers);
}

static inline __m256 extractf32x8_ps(const __m512& a, int part) {
    __m256 half;
    std::memcpy(&half, reinterpret_cast<const char*>(&a) + 32 * part, 32);
    return half;
}
static inline __m256 cvtpd_ps(const __m512d& a) { return each<__m256>(a, [](double x) { return float(x); }); }
static inline __m512d cvtps_pd(const __m256& a) { return each<__m512d>(a, [](float x) { return double(x); }); }
static inline __m256i cvttpd_epi32(const __m512d& a) {
    return each<__m256i>(a, [](double x) { return x > -2147483649.0 && x < 2147483648.0 ? int32_t(x) : INT32_MIN; });
}
static inline __m256i cvttpd_epu32(const __m512d& a) {
    return each<__m256i>(a, [](double x) { return x > -1.0 && x < 4294967296.0 ? uint32_t(x) : UINT32_MAX; });
}
// Both are only called for rounding towards minus infinity.
static inline __m512d roundscale_pd(const __m512d& a, int) { return each<__m512d>(a, [](double x) { return __builtin_floor(x); }); }
static inline __m512 reduce_ps(const __m512& a, int) {
    return each<__m512>(a, [](float x) { return __builtin_isinf(x) ? 0.0f : x - __builtin_floorf(x); });
}
static inline __m512 maskz_loadu_ps(__mmask16 mask, const void* from) {
    float numbers[16] = {};
    for (int i = 0; i < 16; i++)
        if (mask >> i & 1) numbers[i] = static_cast<const float*>(from)[i];
    return same_bits<__m512>(numbers);
}
static inline void stream_ps(void* to, const __m512& a) { std::memcpy(__builtin_assume_aligned(to, 64), &a, 64); }
static inline __m128i cvtepi32_epi8(const __m256i& a) {
    int32_t numbers[8];
    std::memcpy(numbers, &a, 32);
    char bytes[16] = {};
    for (int i = 0; i < 8; i++) bytes[i] = char(numbers[i]);
    return same_bits<__m128i>(bytes);
}

}  // namespace elsewhere

#define _mm256_cvtepi32_epi8 elsewhere::cvtepi32_epi8
#define __AVX512F__ 1
#define __AVX512BW__ 1
