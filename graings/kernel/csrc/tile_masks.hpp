// The bits of a chunk of tile entries: blocks of each entry, and entries of each block.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

// entries[b]: bit j is bit b of masks[j].
GRAINGS_INLINE void by_block(const uint16_t (&masks)[kChunk], uint64_t (&entries)[kBlocks]) {
#if defined(__AVX512BW__)
    const __m512i low = _mm512_loadu_si512(masks), high = _mm512_loadu_si512(masks + 32);
    for (int b = 0; b < kBlocks; b++) {
        const __m512i bit = _mm512_set1_epi16(short(1 << b));
        entries[b] = uint64_t(_mm512_test_epi16_mask(low, bit)) | uint64_t(_mm512_test_epi16_mask(high, bit)) << 32;
    }
#elif defined(__AVX2__)
    // Bit b is shifted to the sign of each mask, which survives packing to bytes. Packing works within register halves.
    __m256i low[2], high[2];
    for (int half = 0; half < 2; half++) {
        const __m256i a = _mm256_loadu_si256((const __m256i*)(masks + 32 * half)), b = _mm256_loadu_si256((const __m256i*)(masks + 32 * half + 16));
        low[half] = _mm256_permute2x128_si256(a, b, 0x20), high[half] = _mm256_permute2x128_si256(a, b, 0x31);
    }
    for (int b = 0; b < kBlocks; b++) {
        const auto of_half = [&](int half) {
            const __m128i by = _mm_cvtsi32_si128(kBlocks - 1 - b);
            return uint32_t(_mm256_movemask_epi8(_mm256_packs_epi16(_mm256_sll_epi16(low[half], by), _mm256_sll_epi16(high[half], by))));
        };
        entries[b] = of_half(0) | uint64_t(of_half(1)) << 32;
    }
#else
    std::memset(entries, 0, sizeof entries);
    for (int j = 0; j < kChunk; j++)
        for (int b = 0; b < kBlocks; b++) entries[b] |= uint64_t(masks[j] >> b & 1) << j;
#endif
}

// masks[j]: bit b is bit j of entries[b].
GRAINGS_INLINE void by_entry(const uint64_t (&entries)[kBlocks], uint16_t (&masks)[kChunk]) {
#if defined(__AVX512BW__)
    __m512i low = _mm512_setzero_si512(), high = low;
    for (int b = 0; b < kBlocks; b++) {
        const __m512i bit = _mm512_set1_epi16(short(1 << b));
        low = _mm512_mask_add_epi16(low, __mmask32(entries[b]), low, bit);
        high = _mm512_mask_add_epi16(high, __mmask32(entries[b] >> 32), high, bit);
    }
    _mm512_storeu_si512(masks, low), _mm512_storeu_si512(masks + 32, high);
#else
    typedef uint16_t Some __attribute__((vector_size(kBytes)));
    constexpr int kSome = kBytes / 2;
    Some bit{};
    for (int j = 0; j < kSome; j++) bit[j] = uint16_t(1 << j);
    for (int first = 0; first < kChunk; first += kSome) {
        Some all{};
        for (int b = 0; b < kBlocks; b++) {
            const uint16_t some = uint16_t(entries[b] >> first), block = uint16_t(1 << b);
            const Some listed = (Some{} + some) & bit;
            all |= (Some)(listed == bit) & block;
        }
        std::memcpy(masks + first, &all, sizeof all);
    }
#endif
}

}  // namespace graings::GRAINGS_ISA
