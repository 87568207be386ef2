// Transposition between eight rows of a table and columns, each a vector of eight float64 numbers.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kGroup = 8;
using D = Vec<double, kGroup>;

// Permutation from eight rows of W numbers to W columns of eight numbers, or back.
template <int W, bool ToRows>
struct Places {
    alignas(64) int32_t at[(8 * W + 15) / 16 * 16] = {};
    constexpr Places() {
        for (int k = 0; k < 8 * W; k++) at[k] = ToRows ? k % W * 8 + k / W : k % 8 * W + k / 8;
    }
};

#if defined(__AVX512F__)
// The `part`-th register of the permuted numbers of up to two registers.
template <int W, bool ToRows>
GRAINGS_INLINE __m512 reordered(__m512 a, __m512 b, int part) {
    static constexpr Places<W, ToRows> places;
    const __m512i at = _mm512_load_si512(places.at + 16 * part);
    return 8 * W > 16 ? _mm512_permutex2var_ps(a, at, b) : _mm512_permutexvar_ps(at, a);
}

// Transposes an 8x8 matrix in registers.
GRAINGS_INLINE void transpose(__m512d (&x)[8]) {
    __m512d two[2][4];  // columns odd, 2 + odd, 4 + odd and 6 + odd of rows 2k and 2k + 1
    for (int k = 0; k < 4; k++) two[0][k] = _mm512_unpacklo_pd(x[2 * k], x[2 * k + 1]), two[1][k] = _mm512_unpackhi_pd(x[2 * k], x[2 * k + 1]);
    for (int odd = 0; odd < 2; odd++) {
        const __m512d a = _mm512_shuffle_f64x2(two[odd][0], two[odd][1], 0x44), b = _mm512_shuffle_f64x2(two[odd][2], two[odd][3], 0x44);
        const __m512d c = _mm512_shuffle_f64x2(two[odd][0], two[odd][1], 0xEE), d = _mm512_shuffle_f64x2(two[odd][2], two[odd][3], 0xEE);
        x[odd] = _mm512_shuffle_f64x2(a, b, 0x88), x[2 + odd] = _mm512_shuffle_f64x2(a, b, 0xDD);
        x[4 + odd] = _mm512_shuffle_f64x2(c, d, 0x88), x[6 + odd] = _mm512_shuffle_f64x2(c, d, 0xDD);
    }
}
#elif defined(__AVX2__)
// The `part`-th register of the permuted numbers of W registers.
template <int W, bool ToRows>
GRAINGS_INLINE __m256 reordered(const __m256 (&x)[W], int part) {
    static constexpr Places<W, ToRows> places;
    const __m256i at = _mm256_load_si256(reinterpret_cast<const __m256i*>(places.at + 8 * part)), source = _mm256_srli_epi32(at, 3);
    __m256 found = _mm256_permutevar8x32_ps(x[0], at);  // uses the lowest three bits of each index
    for (int k = 1; k < W; k++)
        found = _mm256_blendv_ps(found, _mm256_permutevar8x32_ps(x[k], at), _mm256_castsi256_ps(_mm256_cmpeq_epi32(source, _mm256_set1_epi32(k))));
    return found;
}

// Transposes a 4x4 matrix in registers.
GRAINGS_INLINE void transpose(__m256d (&x)[4]) {
    const __m256d even = _mm256_unpacklo_pd(x[0], x[1]), odd = _mm256_unpackhi_pd(x[0], x[1]);
    const __m256d below_even = _mm256_unpacklo_pd(x[2], x[3]), below_odd = _mm256_unpackhi_pd(x[2], x[3]);
    x[0] = _mm256_permute2f128_pd(even, below_even, 0x20), x[1] = _mm256_permute2f128_pd(odd, below_odd, 0x20);
    x[2] = _mm256_permute2f128_pd(even, below_even, 0x31), x[3] = _mm256_permute2f128_pd(odd, below_odd, 0x31);
}

GRAINGS_INLINE __m256d low(D x) { return (__m256d)x.lo.v; }
GRAINGS_INLINE __m256d high(D x) { return (__m256d)x.hi.v; }
GRAINGS_INLINE D both(__m256d low, __m256d high) { return {{(Native<double>)low}, {(Native<double>)high}}; }
// Conversion of non-negative integers below 2^31.
GRAINGS_INLINE __m256i whole(D x) { return _mm256_set_m128i(_mm256_cvttpd_epi32(high(x)), _mm256_cvttpd_epi32(low(x))); }
#endif

// The columns of rows begin..begin+7 of a row-major [N, W] array; beyond the end the last row is repeated.
template <int W, class R>
GRAINGS_INLINE void columns_of(const R* rows, int64_t begin, int64_t count, D* columns) {
    if constexpr (W == 1)
        if (begin + kGroup <= count) {
            columns[0] = load_as<kGroup>(rows + begin);
            return;
        }
#if defined(__AVX512F__)
    if constexpr (sizeof(R) == 4)
        if (begin + kGroup <= count) {
            constexpr int second = 8 * W - 16;
            const float* p = rows + begin * W;
            const __m512 a = W == 1 ? _mm512_castps256_ps512(_mm256_loadu_ps(p)) : _mm512_loadu_ps(p);
            const __m512 b = second <= 0 ? a : second == 8 ? _mm512_castps256_ps512(_mm256_loadu_ps(p + 16)) : _mm512_loadu_ps(p + 16);
            for (int part = 0; part < (W + 1) / 2; part++) {
                const __m512 pair = W == 1 ? a : reordered<W, false>(a, b, part);
                columns[2 * part].v = (Native<double>)_mm512_cvtps_pd(_mm512_castps512_ps256(pair));
                if (2 * part + 1 < W) columns[2 * part + 1].v = (Native<double>)_mm512_cvtps_pd(_mm512_extractf32x8_ps(pair, 1));
            }
            return;
        }
#elif defined(__AVX2__)
    if constexpr (sizeof(R) == 4)
        if (begin + kGroup <= count) {
            __m256 x[W];
            for (int part = 0; part < W; part++) x[part] = _mm256_loadu_ps(rows + begin * W + kGroup * part);
            for (int c = 0; c < W; c++) {
                const __m256 column = reordered<W, false>(x, c);
                columns[c] = both(_mm256_cvtps_pd(_mm256_castps256_ps128(column)), _mm256_cvtps_pd(_mm256_extractf128_ps(column, 1)));
            }
            return;
        }
#endif
    R lanes[W][kGroup];
    for (int i = 0; i < kGroup; i++) {
        const R* row = rows + (begin + i < count ? begin + i : count - 1) * W;
        for (int c = 0; c < W; c++) lanes[c][i] = row[c];
    }
    for (int c = 0; c < W; c++) columns[c] = load_as<kGroup>(lanes[c]);
}

// The inverse, rounded to R, for the rows before `end`.
template <int W, class R>
GRAINGS_INLINE void store_columns(R* rows, int64_t begin, int64_t end, const D* columns) {
    if constexpr (W == 1)
        if (begin + kGroup <= end) {
            store_as<R>(rows + begin, columns[0]);
            return;
        }
#if defined(__AVX512F__)
    if constexpr (sizeof(R) == 4)
        if (begin + kGroup <= end) {
            const auto two = [&](int c) {
                const __m256 low = _mm512_cvtpd_ps((__m512d)columns[c].v), high = c + 1 < W ? _mm512_cvtpd_ps((__m512d)columns[c + 1 < W ? c + 1 : c].v) : low;
                return _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1);
            };
            const __m512 a = two(0), b = W > 2 ? two(2) : a;
            for (int part = 0; part < (W + 1) / 2; part++) {
                const __m512 ordered = W == 1 ? a : reordered<W, true>(a, b, part);
                float* p = rows + begin * W + 16 * part;
                if (8 * W - 16 * part >= 16) _mm512_storeu_ps(p, ordered);
                else _mm256_storeu_ps(p, _mm512_castps512_ps256(ordered));
            }
            return;
        }
#elif defined(__AVX2__)
    if constexpr (sizeof(R) == 4)
        if (begin + kGroup <= end) {
            __m256 x[W];
            for (int c = 0; c < W; c++) x[c] = (__m256)rounded<R>(columns[c]).v;
            for (int part = 0; part < W; part++) _mm256_storeu_ps(rows + begin * W + kGroup * part, reordered<W, true>(x, part));
            return;
        }
#endif
    R lanes[W][kGroup];
    for (int c = 0; c < W; c++) store_as<R>(lanes[c], columns[c]);
    for (int i = 0; i < kGroup && begin + i < end; i++)
        for (int c = 0; c < W; c++) rows[(begin + i) * W + c] = lanes[c][i];
}

}  // namespace graings::GRAINGS_ISA
