// The gradient of one tile's pixels, back to front: forward once more to keep alpha and weight of every entry and
// block, then the recurrence of what lies behind (numerically stable: nothing is subtracted or divided).
#pragma once
#include "tiles.hpp"

namespace graings::GRAINGS_ISA {

// out[q] = sum of the 16 numbers of v[q], for twelve of them at once.
template <class R>
GRAINGS_INLINE void sums_of_twelve(const P<R>* v, R* out) {
#if defined(__AVX512F__)
    if constexpr (sizeof(R) == 4) {
        // Halve three times, two vectors into one each time; each keeps its own part of the lanes.
        const auto halves = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xDD)); };
        const auto pairs = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xDD)); };
        __m512 quarter[3];
        for (int i = 0; i < 3; i++) {
            const P<R>* four = v + 4 * i;
            // lanes 4q..4q+3: the four partial sums of vector q
            quarter[i] = halves(halves((__m512)four[0].v, (__m512)four[1].v), halves((__m512)four[2].v, (__m512)four[3].v));
        }
        const __m512 last = pairs(pairs(quarter[0], quarter[1]), pairs(quarter[2], quarter[2]));
        // quad q: vector q of quarters 0, 1, 2, 2
        const __m512i in_order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
        _mm512_mask_storeu_ps(out, 0x0FFF, _mm512_permutexvar_ps(in_order, last));
        return;
    }
#endif
    for (int q = 0; q < kSlot; q++) out[q] = sum(v[q]);
}

template <class R, bool Compat, bool Extra>
GRAINGS_INLINE void gradient(const TileGradientArgs<R>& all, int64_t tile, const TileScratch<R>& scratch) {
    const TileArgs<R>& args = all.tiles;
    const TileBox box = tile_box(args.camera, tile);
    const Rule<R> limits = rule<R>(args.settings);
    const P<R> columns = lanes_of<R>(kColumns), rows = lanes_of<R>(kRows), zero = p16(R(0));
    const int64_t begin = args.begin[tile], end = args.begin[tile + 1];
    double* v_ground = all.v_background + 3 * tile;
    v_ground[0] = v_ground[1] = v_ground[2] = 0;

    // upstream: colour, then alpha, then depth
    alignas(64) R up[5][kBlocks][kLanes];
    typename Bits<R>::type noise = 0;  // a NaN is not silence
    const auto hear = [&](const R* row, int n) {
        for (int i = 0; i < n; i++) {
            typename Bits<R>::type word;
            std::memcpy(&word, row + i, sizeof word);
            noise |= word << 1;  // -0 is 0
        }
    };
    for (int y = 0; y < kTile; y++) {
        R color[3 * kTile] = {}, alpha[kTile] = {}, depth[kTile] = {};
        if (y < box.height) {
            const int64_t pixel = (box.top + y) * args.camera.width + box.left;
            std::memcpy(color, all.v_color + 3 * pixel, sizeof(R) * size_t(3 * box.width));
            hear(color, 3 * kTile);
            if (Extra && all.v_alpha) std::memcpy(alpha, all.v_alpha + pixel, sizeof(R) * size_t(box.width)), hear(alpha, kTile);
            if (Extra && all.v_depth) std::memcpy(depth, all.v_depth + pixel, sizeof(R) * size_t(box.width)), hear(depth, kTile);
        }
        for (int x = 0; x < kTile; x++) {
            const int b = (y >> 2) * 4 + (x >> 2), l = (y & 3) * 4 + (x & 3);
            for (int c = 0; c < 3; c++) up[c][b][l] = color[3 * x + c];
            if constexpr (Extra) up[3][b][l] = alpha[x], up[4][b][l] = depth[x];
        }
    }
    const bool silent = noise == 0;
    if (silent) {
        for (int64_t k = begin; k < end; k++) std::memset(all.sums + int64_t(all.slots[k]) * kSlot, 0, sizeof(R) * kSlot);
        return;
    }

    // forward again, to keep alpha and weight of every (entry, block)
    alignas(64) R open[kBlocks][kLanes], light[kBlocks][kLanes], behind[kBlocks][kLanes];
    open_lanes(box, open);
    std::memcpy(light, open, sizeof light);
    const int n = args.processed[tile];
    int32_t item = 0;
    for (int first = 0; first < n; first += kChunk) {
        const int count = n - first < kChunk ? n - first : kChunk;
        uint16_t masks[kChunk] = {};
        uint32_t lists[kBlocks];
        for (int i = 0; i < count; i++) {
            const int j = first + i;
            if (j + 8 < n) __builtin_prefetch(&args.records[args.ids[begin + j + 8]]);
            masks[i] = args.masks[begin + j];
            scratch.first_item[j] = item;
            item += __builtin_popcount(masks[i]);
            if (masks[i]) prepare(scratch.entries[j], args.records[args.ids[begin + j]], double(box.left), double(box.top));
        }
        by_block(masks, lists);
        for (int b = 0; b < kBlocks; b++) {
            if (lists[b] == 0) continue;
            P<R> t = load<kLanes>(light[b]), going = load<kLanes>(open[b]);
            for (uint32_t list = lists[b]; list; list &= list - 1) {
                const int i = __builtin_ctz(list);
                const int64_t at = (scratch.first_item[first + i] + __builtin_popcount(masks[i] & ((1u << b) - 1))) * kLanes;
                const TileEntry<R>& entry = scratch.entries[first + i];
                const P<R> raw = uncapped_alpha(entry, distance(entry, b, columns, rows));
                const Step<R> step = blend<R, Compat>(raw, limits, t, going);
                store(scratch.alphas + at, step.alpha);
                store(scratch.weights + at, select(p16(limits.alpha_max) < raw, zero - step.weight, step.weight));
            }
            store(light[b], t), store(open[b], going);
        }
    }

    // what a pixel sees behind the current entry, weighed by its upstream: starts at the background
    for (int b = 0; b < kBlocks; b++) {
        const P<R> t = load<kLanes>(light[b]);
        P<R> sum_ = zero;
        for (int c = 0; c < 3; c++) {
            const P<R> g = load<kLanes>(up[c][b]);
            sum_ = fma(g, p16(args.background[c]), sum_);
            v_ground[c] += double(sum(g * t));
        }
        store(behind[b], sum_);
    }

    for (int64_t k = begin + n; k < end; k++) std::memset(all.sums + int64_t(all.slots[k]) * kSlot, 0, sizeof(R) * kSlot);
    for (int j = n - 1; j >= 0; j--) {
        R* slot = all.sums + int64_t(all.slots[begin + j]) * kSlot;
        uint32_t mask = args.masks[begin + j];
        if (!mask) {
            std::memset(slot, 0, sizeof(R) * kSlot);
            continue;
        }
        const TileEntry<R>& entry = scratch.entries[j];
        const R* alphas = scratch.alphas + int64_t(scratch.first_item[j]) * kLanes;
        const R* weights = scratch.weights + int64_t(scratch.first_item[j]) * kLanes;
        P<R> e = zero, er = zero, es = zero, err = zero, ers = zero, ess = zero;
        P<R> red = zero, green = zero, blue = zero, depth = zero;
        for (; mask; mask &= mask - 1, alphas += kLanes, weights += kLanes) {
            const int b = __builtin_ctz(mask);
            const Distance<R> d = distance(entry, b, columns, rows);
            const P<R> alpha = load<kLanes>(alphas), signed_weight = load<kLanes>(weights);
            const P<R> passing = max(signed_weight, zero);            // capped alpha passes no gradient
            const P<R> weight = abs(signed_weight);
            const P<R> g0 = load<kLanes>(up[0][b]), g1 = load<kLanes>(up[1][b]), g2 = load<kLanes>(up[2][b]);
            P<R> own = fma(g0, p16(entry.red), fma(g1, p16(entry.green), g2 * p16(entry.blue)));
            if constexpr (Extra) {
                const P<R> g4 = load<kLanes>(up[4][b]);
                own = fma(g4, p16(entry.depth), own + load<kLanes>(up[3][b]));
                depth = fma(weight, g4, depth);
            }
            const P<R> back = load<kLanes>(behind[b]);
            const P<R> ge = passing * (back - own);
            store(behind[b], fma(alpha, own, (p16(R(1)) - alpha) * back));
            const P<R> ge_r = ge * d.r, ge_s = ge * d.s;
            e = e + ge, er = er + ge_r, es = es + ge_s;
            err = fma(ge_r, d.r, err), ers = fma(ge_r, d.s, ers), ess = fma(ge_s, d.s, ess);
            red = fma(weight, g0, red), green = fma(weight, g1, green), blue = fma(weight, g2, blue);
        }
        const P<R> totals[kSlot] = {e, er, es, err, ers, ess, red, green, blue, depth, zero, zero};
        sums_of_twelve(totals, slot);
    }
}

template <class R>
static void tile_gradient(const TileGradientArgs<R>& args, int64_t tile, const TileScratch<R>& scratch) {
    const bool extra = args.v_alpha || args.v_depth, compat = args.tiles.settings.compat;
    if (compat) gradient<R, true, true>(args, tile, scratch);
    else if (extra) gradient<R, false, true>(args, tile, scratch);
    else gradient<R, false, false>(args, tile, scratch);
}

}  // namespace graings::GRAINGS_ISA
