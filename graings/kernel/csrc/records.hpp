// The tables of the rasterizer, written from columns of eight Gaussians: records, spans, bytes, and sums of gradients.
#pragma once
#include "columns.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

#if defined(__AVX512F__)
// Eight records from their columns: float64 numbers, and pairs of float32 numbers of the same size.
GRAINGS_INLINE void store_records(Record<float>* to, const D* whole, const D (*pairs)[2]) {
    __m512d column[8] = {};  // the last one is not used
    for (int c = 0; c < 3; c++) column[c] = (__m512d)whole[c].v;
    const __m512i alternate = _mm512_setr_epi32(0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
    for (int c = 3; c < 7; c++) {
        const __m256 low = _mm512_cvtpd_ps((__m512d)pairs[c - 3][0].v), high = _mm512_cvtpd_ps((__m512d)pairs[c - 3][1].v);
        column[c] = _mm512_castps_pd(_mm512_permutexvar_ps(alternate, _mm512_insertf32x8(_mm512_castps256_ps512(low), high, 1)));
    }
    transpose(column);
    for (int row = 0; row < 8; row++) _mm512_storeu_pd(to + row, column[row]);
}
#elif defined(__AVX2__)
// Eight records from their columns: float64 numbers, and pairs of float32 numbers of the same size.
GRAINGS_INLINE void store_records(Record<float>* to, const D* whole, const D (*pairs)[2]) {
    const auto pair = [&](int c, bool upper) {
        const __m128 first = _mm256_cvtpd_ps(upper ? high(pairs[c][0]) : low(pairs[c][0])), second = _mm256_cvtpd_ps(upper ? high(pairs[c][1]) : low(pairs[c][1]));
        return _mm256_castps_pd(_mm256_set_m128(_mm_unpackhi_ps(first, second), _mm_unpacklo_ps(first, second)));
    };
    const auto put = [&](int row, int from, __m256d a, __m256d b, __m256d c, __m256d d) {
        __m256d x[4] = {a, b, c, d};
        transpose(x);
        for (int k = 0; k < 4; k++) _mm256_store_pd(reinterpret_cast<double*>(to + row + k) + from, x[k]);
    };
    put(0, 0, low(whole[0]), low(whole[1]), low(whole[2]), pair(0, false));
    put(0, 4, pair(1, false), pair(2, false), pair(3, false), _mm256_setzero_pd());
    put(4, 0, high(whole[0]), high(whole[1]), high(whole[2]), pair(0, true));
    put(4, 4, pair(1, true), pair(2, true), pair(3, true), _mm256_setzero_pd());
}
#endif

// Writes records begin..begin+7 before `end`.
template <class R>
GRAINGS_INLINE void put_records(Record<R>* records, int64_t begin, int64_t end, const D* whole, const D (*pairs)[2]) {
#if defined(__AVX2__)
    if constexpr (sizeof(R) == 4)
        if (begin + kGroup <= end) {
            store_records(records + begin, whole, pairs);
            return;
        }
#endif
    double x[3][kGroup];
    R y[8][kGroup];
    for (int c = 0; c < 3; c++) store(x[c], whole[c]);
    for (int c = 0; c < 8; c++) store_as<R>(y[c], pairs[c / 2][c % 2]);
    for (int i = 0; i < kGroup && begin + i < end; i++)
        records[begin + i] = {x[0][i], x[1][i], x[2][i], {y[0][i], y[1][i], y[2][i], y[3][i], y[4][i], y[5][i], y[6][i], y[7][i]}};
}

// Writes spans begin..begin+7 before `end`: the number of tiles, and the sides in blocks.
GRAINGS_INLINE void put_spans(Span* spans, int64_t begin, int64_t end, D tiles, const D (&sides)[4]) {
#if defined(__AVX512F__)
    if (begin + kGroup <= end) {
        // three columns of 32 bits: the count, and two sides each
        const auto whole = [](D x) { return _mm512_cvttpd_epu32((__m512d)x.v); };
        const auto side = [&](const D& low, const D& high) { return whole(fma(splat<double, kGroup>(65536), high, low)); };
        const __m512 a = _mm512_castsi512_ps(_mm512_inserti32x8(_mm512_castsi256_si512(whole(tiles)), side(sides[0], sides[1]), 1));
        const __m512 b = _mm512_castsi512_ps(_mm512_castsi256_si512(side(sides[2], sides[3])));
        float* to = reinterpret_cast<float*>(spans + begin);
        _mm512_storeu_ps(to, reordered<3, true>(a, b, 0)), _mm256_storeu_ps(to + 16, _mm512_castps512_ps256(reordered<3, true>(a, b, 1)));
        return;
    }
#elif defined(__AVX2__)
    if (begin + kGroup <= end) {
        const auto side = [](D low, D high) { return _mm256_castsi256_ps(_mm256_or_si256(whole(low), _mm256_slli_epi32(whole(high), 16))); };
        const __m256 columns[3] = {_mm256_castsi256_ps(whole(tiles)), side(sides[0], sides[1]), side(sides[2], sides[3])};
        for (int part = 0; part < 3; part++) _mm256_storeu_ps(reinterpret_cast<float*>(spans + begin) + kGroup * part, reordered<3, true>(columns, part));
        return;
    }
#endif
    double count[kGroup], side[4][kGroup];
    store(count, tiles);
    for (int i = 0; i < 4; i++) store(side[i], sides[i]);
    const auto block = [](double x) { return uint16_t(int32_t(x)); };
    for (int i = 0; i < kGroup && begin + i < end; i++)
        spans[begin + i] = {uint32_t(int32_t(count[i])), block(side[0][i]), block(side[1][i]), block(side[2][i]), block(side[3][i])};
}

// Writes bytes begin..begin+7 before `end`.
GRAINGS_INLINE void put_bytes(uint8_t* bytes, int64_t begin, int64_t end, D numbers) {
#if defined(__AVX512F__)
    if (begin + kGroup <= end) {
        _mm_storeu_si64(bytes + begin, _mm256_cvtepi32_epi8(_mm512_cvttpd_epi32((__m512d)numbers.v)));
        return;
    }
#elif defined(__AVX2__)
    if (begin + kGroup <= end) {
        const __m256i wide = whole(numbers);
        const __m128i half = _mm_packs_epi32(_mm256_castsi256_si128(wide), _mm256_extracti128_si256(wide, 1));
        _mm_storeu_si64(bytes + begin, _mm_packus_epi16(half, half));
        return;
    }
#endif
    double whole[kGroup];
    store(whole, numbers);
    for (int i = 0; i < kGroup && begin + i < end; i++) bytes[begin + i] = uint8_t(int32_t(whole[i]));
}

// The total of the partial sums of a Gaussian's pairs.
struct Sums { D first, rest; };

// Adds a pair's sums if `any`, without a branch: it would be mispredicted half of the time, which costs more than adding.
template <class R>
GRAINGS_INLINE void add_sums(const R* of_pair, bool any, Sums& total) {
#if defined(__AVX512F__)
    if constexpr (sizeof(R) == 4) {
        const __m512 sums = _mm512_maskz_loadu_ps(__mmask16(-int(any)) & ((1 << kSums) - 1), of_pair);
        total.first.v += (Native<double>)_mm512_cvtps_pd(_mm512_castps512_ps256(sums));
        total.rest.v += (Native<double>)_mm512_cvtps_pd(_mm512_extractf32x8_ps(sums, 1));
        return;
    }
#elif defined(__AVX2__)
    if constexpr (sizeof(R) == 4) {
        const int all = -int(any);
        const __m256 first = _mm256_maskload_ps(of_pair, _mm256_set1_epi32(all));
        const __m128 rest = _mm_maskload_ps(of_pair + kGroup, _mm_setr_epi32(all, all, 0, 0));
        total.first = total.first + both(_mm256_cvtps_pd(_mm256_castps256_ps128(first)), _mm256_cvtps_pd(_mm256_extractf128_ps(first, 1)));
        total.rest = total.rest + both(_mm256_cvtps_pd(rest), _mm256_setzero_pd());
        return;
    }
#endif
    if (!any) return;
    double rest[kGroup] = {};
    for (int q = kGroup; q < kSums; q++) rest[q - kGroup] = double(of_pair[q]);
    total.first = total.first + load_as<kGroup>(of_pair);
    total.rest = total.rest + load<kGroup>(rest);
}

// The columns of eight rows of sums.
GRAINGS_INLINE void columns_of_sums(const double (&rows)[kGroup][kSumStride], D (&columns)[kSums]) {
    static_assert(kSums == kGroup + 2);
#if defined(__AVX512F__)
    __m512d x[8];
    for (int i = 0; i < 8; i++) x[i] = _mm512_loadu_pd(rows[i]);
    transpose(x);
    for (int c = 0; c < 8; c++) columns[c].v = (Native<double>)x[c];
    const auto two = [&](int row) { return _mm_loadu_pd(rows[row] + 8); };
    const auto every_other = [&](int row) {
        const __m512d half = _mm512_insertf64x2(_mm512_castpd128_pd512(two(row)), two(row + 2), 1);
        return _mm512_insertf64x2(_mm512_insertf64x2(half, two(row + 4), 2), two(row + 6), 3);
    };
    const __m512d even = every_other(0), odd = every_other(1);
    columns[8].v = (Native<double>)_mm512_unpacklo_pd(even, odd), columns[9].v = (Native<double>)_mm512_unpackhi_pd(even, odd);
#elif defined(__AVX2__)
    for (int part = 0; part < kSums; part += 4) {  // the last part has two unused columns
        __m256d above[4], below[4];
        for (int i = 0; i < 4; i++) above[i] = _mm256_loadu_pd(rows[i] + part), below[i] = _mm256_loadu_pd(rows[4 + i] + part);
        transpose(above), transpose(below);
        for (int c = 0; c < 4 && part + c < kSums; c++) columns[part + c] = both(above[c], below[c]);
    }
#else
    double lanes[kSums][kGroup];
    for (int i = 0; i < kGroup; i++)
        for (int c = 0; c < kSums; c++) lanes[c][i] = rows[i][c];
    for (int c = 0; c < kSums; c++) columns[c] = load<kGroup>(lanes[c]);
#endif
}

}  // namespace graings::GRAINGS_ISA
