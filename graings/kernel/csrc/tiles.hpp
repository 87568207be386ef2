// The pixels of one tile: compositing front to back, and its gradient back to front.
// A block of 4x4 pixels is one vector of 16 lanes. Both directions evaluate alpha by the same function.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

template <class R> using P = Vec<R, kLanes>;
template <class R> GRAINGS_INLINE P<R> p16(R x) { return splat<R, kLanes>(x); }

// Of a tile's blocks: first pixel column and row.
alignas(64) constexpr double kBlockX[kBlocks] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
alignas(64) constexpr double kBlockY[kBlocks] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};
// Of a block's pixels: distance from its centre.
alignas(64) constexpr double kColumns[kLanes] = {-1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5};
alignas(64) constexpr double kRows[kLanes] = {-1.5, -1.5, -1.5, -1.5, -0.5, -0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5};
template <class R>
GRAINGS_INLINE P<R> lanes_of(const double* numbers) {
    R lanes[kLanes];
    store_as<R>(lanes, load<kLanes>(numbers));
    return load<kLanes>(lanes);
}

template <class R>
GRAINGS_INLINE void prepare(TileEntry<R>& entry, const Record<R>& record, double left, double top) {
    const double dy = top + 2 - record.y, tilt = record.sr * record.slope;
    entry = {record.sr * ((left + 2 - record.x) - record.slope * dy), record.sy * dy, record.sr, tilt, record.sy, R(record.sr), R(tilt), R(record.sy),
             record.opacity, record.red, record.green, record.blue, record.depth};
}

// Blocks that a prepared entry reaches, one bit each: those where the least exponent over the rectangle of pixel
// centres is at most the record's level. With u = |r| less half the width of the block, or 0, the exponent
// u^2 + s^2 is convex in dy and smooth. Where s is least, either u is 0 and nothing is lower, or the lowest point
// lies on the side of r's sign, where u is linear, or at an end. `slack` is more than all rounding of r, s and
// those points, here and in the pixels.
template <class R>
GRAINGS_INLINE uint32_t reached_blocks(const TileEntry<R>& entry, R reach) {
    constexpr R unit = sizeof(R) == 4 ? R(1e-6) : R(2e-15);
    const auto size = [](R x) { return x < R(0) ? -x : x; };
    const R wide = entry.wide, rise = entry.rise, lean = entry.lean, steep = lean * lean, fall = R(1) / (steep + rise * rise);
    const R slack = unit * (size(R(entry.r)) + size(R(entry.s)) + R(32) * (wide + rise + size(lean)));
    const P<R> zero = p16(R(0)), high = p16(R(1.5)), low = p16(R(-1.5)), edge = p16(R(1.5) * wide + slack), loose = p16(slack);
    const P<R> x = lanes_of<R>(kBlockX), y = lanes_of<R>(kBlockY), level = p16(reach);
    const P<R> r = fma(p16(wide), x, fma(p16(-lean), y, p16(R(entry.r)))), s = fma(p16(rise), y, p16(R(entry.s)));
    const auto out = [&](P<R> t, P<R> dy) {
        const P<R> u = max(abs(t) - edge, zero), v = max(abs(fma(p16(rise), dy, s)) - loose, zero);
        return bits(level < fma(u, u, v * v));
    };
    const P<R> flat = clamp(p16(R(-1) / rise) * s, low, high), t = fma(p16(-lean), flat, r);
    const P<R> side = select(t < zero, p16(R(-1.5) * wide), p16(R(1.5) * wide));
    const P<R> lowest = clamp(fma(p16(lean * fall), r - side, p16(-rise * fall) * s), low, high);
    return ~(out(t, flat) & out(fma(p16(-lean), lowest, r), lowest));
}

// entries[b]: which of n <= 32 masks have bit b.
GRAINGS_INLINE void by_block(const uint16_t* masks, uint32_t* entries) {
#if defined(__AVX512BW__)
    const __m512i all = _mm512_loadu_si512(masks);
    for (int b = 0; b < kBlocks; b++) entries[b] = _mm512_test_epi16_mask(all, _mm512_set1_epi16(short(1 << b)));
#else
    std::memset(entries, 0, sizeof(uint32_t) * kBlocks);
    for (int j = 0; j < kChunk; j++)
        for (int b = 0; b < kBlocks; b++) entries[b] |= uint32_t(masks[j] >> b & 1) << j;
#endif
}
template <class R> struct Distance { P<R> r, s; };

// Rounded to R only here, relative to the block, so that they stay accurate however far the mean is and however
// long the needle.
template <class R>
GRAINGS_INLINE Distance<R> distance(const TileEntry<R>& entry, int block, P<R> columns, P<R> rows) {
    const double x = kBlockX[block], y = kBlockY[block];
    const R r = R(entry.r + (entry.sr * x - entry.tilt * y)), s = R(entry.s + entry.sy * y);
    return {fma(p16(entry.wide), columns, fma(p16(-entry.lean), rows, p16(r))), fma(p16(entry.rise), rows, p16(s))};
}

template <class R>
GRAINGS_INLINE P<R> uncapped_alpha(const TileEntry<R>& entry, const Distance<R>& d) {
    return p16(entry.opacity) * exp2_minus(fma(d.r, d.r, d.s * d.s));
}

template <class R> struct Rule { R alpha_min, alpha_max, transmittance_min; };
template <class R>
GRAINGS_INLINE Rule<R> rule(const Settings& s) { return {R(s.alpha_min), R(s.alpha_max), R(s.transmittance_min)}; }

// One step of light through a pixel. `light` is what still passes; a pixel below transmittance_min has stopped and
// keeps it. In compat the entry that would cross is left out, and `open` remembers that the pixel has stopped.
template <class R> struct Step { P<R> alpha, weight; };  // both 0 where the entry does not count

template <class R, bool Compat>
GRAINGS_INLINE Step<R> blend(P<R> raw, const Rule<R>& rule, P<R>& light, P<R>& open) {
    const P<R> zero = p16(R(0)), stop = p16(rule.transmittance_min), capped = min(raw, p16(rule.alpha_max));
    const auto drawn = p16(rule.alpha_min) <= raw;
    if constexpr (Compat) {
        P<R> alpha = select(drawn & (zero < open), capped, zero);
        const P<R> next = light * (p16(R(1)) - alpha);
        const auto stops = next < stop;
        open = select(stops, zero, open), alpha = select(stops, zero, alpha);
        const P<R> weight = alpha * light;
        light = select(stops, light, next);
        return {alpha, weight};
    } else {
        const P<R> alpha = select(drawn & (stop <= light), capped, zero), weight = alpha * light;
        light = light * (p16(R(1)) - alpha);
        return {alpha, weight};
    }
}

struct TileBox {
    int64_t left, top, width, height;  // width, height: pixels of the tile inside the image
};
GRAINGS_INLINE TileBox tile_box(const Camera& k, int64_t tile) {
    const int64_t across = (k.width + kTile - 1) / kTile;
    const int64_t left = tile % across * kTile, top = tile / across * kTile;
    const int64_t w = k.width - left, h = k.height - top;
    return {left, top, w < kTile ? w : kTile, h < kTile ? h : kTile};
}
GRAINGS_INLINE int lane_x(int block, int lane) { return (block & 3) * 4 + (lane & 3); }
GRAINGS_INLINE int lane_y(int block, int lane) { return (block >> 2) * 4 + (lane >> 2); }

// Blocks with at least one pixel, and 1 or 0 for every lane.
template <class R>
GRAINGS_INLINE uint32_t open_lanes(const TileBox& box, R (*open)[kLanes]) {
    uint32_t live = 0;
    for (int b = 0; b < kBlocks; b++)
        for (int l = 0; l < kLanes; l++) {
            const bool inside = lane_x(b, l) < box.width && lane_y(b, l) < box.height;
            open[b][l] = R(inside);
            live |= uint32_t(inside) << b;
        }
    return live;
}

template <class R, bool Compat>
GRAINGS_INLINE void draw(const TileArgs<R>& args, int64_t tile, TileEntry<R>* chunk) {
    const TileBox box = tile_box(args.camera, tile);
    const Rule<R> limits = rule<R>(args.settings);
    const P<R> columns = lanes_of<R>(kColumns), rows = lanes_of<R>(kRows);
    alignas(64) R open[kBlocks][kLanes], light[kBlocks][kLanes], channels[4][kBlocks][kLanes];
    uint32_t live = open_lanes(box, open);
    std::memcpy(light, open, sizeof light);
    std::memset(channels, 0, sizeof channels);

    int64_t k = args.begin[tile];
    const int64_t end = args.begin[tile + 1], start = k;
    int32_t items = 0;
    while (k < end && live) {
        const int n = int(end - k < kChunk ? end - k : kChunk);
        uint16_t masks[kChunk] = {};
        uint32_t lists[kBlocks];
        for (int j = 0; j < n; j++) {
            if (k + j + 8 < end) __builtin_prefetch(&args.records[args.ids[k + j + 8]]);
            const Record<R>& record = args.records[args.ids[k + j]];
            prepare(chunk[j], record, double(box.left), double(box.top));
            args.masks[k + j] = masks[j] = uint16_t((Compat ? 0xFFFFu : reached_blocks(chunk[j], record.level)) & live);
            items += __builtin_popcount(masks[j]);
        }
        k += n;
        by_block(masks, lists);
        for (int b = 0; b < kBlocks; b++) {
            if (lists[b] == 0) continue;
            P<R> t = load<kLanes>(light[b]), going = load<kLanes>(open[b]);
            P<R> red = load<kLanes>(channels[0][b]), green = load<kLanes>(channels[1][b]);
            P<R> blue = load<kLanes>(channels[2][b]), depth = load<kLanes>(channels[3][b]);
            for (uint32_t list = lists[b]; list; list &= list - 1) {
                const TileEntry<R>& entry = chunk[__builtin_ctz(list)];
                const P<R> weight = blend<R, Compat>(uncapped_alpha(entry, distance(entry, b, columns, rows)), limits, t, going).weight;
                red = fma(weight, p16(entry.red), red);
                green = fma(weight, p16(entry.green), green);
                blue = fma(weight, p16(entry.blue), blue);
                depth = fma(weight, p16(entry.depth), depth);
            }
            store(light[b], t), store(open[b], going);
            store(channels[0][b], red), store(channels[1][b], green), store(channels[2][b], blue), store(channels[3][b], depth);
            if (!any(Compat ? p16(R(0)) < going : p16(limits.transmittance_min) <= t)) live &= ~(1u << b);
        }
    }
    args.processed[tile] = int32_t(k - start);
    args.items[tile] = items;

    for (int b = 0; b < kBlocks; b++) {
        const P<R> t = load<kLanes>(light[b]);
        for (int c = 0; c < 3; c++) store(channels[c][b], fma(t, p16(args.background[c]), load<kLanes>(channels[c][b])));
        store(light[b], p16(R(1)) - t);
    }
    for (int y = 0; y < box.height; y++) {
        R color[3 * kTile], alpha[kTile], depth[kTile];
        for (int x = 0; x < kTile; x++) {
            const int b = (y >> 2) * 4 + (x >> 2), l = (y & 3) * 4 + (x & 3);
            color[3 * x] = channels[0][b][l], color[3 * x + 1] = channels[1][b][l], color[3 * x + 2] = channels[2][b][l];
            alpha[x] = light[b][l], depth[x] = channels[3][b][l];
        }
        const int64_t pixel = (box.top + y) * args.camera.width + box.left;
        std::memcpy(args.color + 3 * pixel, color, sizeof(R) * size_t(3 * box.width));
        std::memcpy(args.alpha + pixel, alpha, sizeof(R) * size_t(box.width));
        std::memcpy(args.depth + pixel, depth, sizeof(R) * size_t(box.width));
    }
}

// A tile that nothing touches.
template <class R>
GRAINGS_INLINE void draw_background(const TileArgs<R>& args, int64_t tile) {
    const TileBox box = tile_box(args.camera, tile);
    args.processed[tile] = args.items[tile] = 0;
    R color[3 * kTile];
    for (int i = 0; i < 3 * kTile; i++) color[i] = args.background[i % 3];
    for (int64_t y = 0; y < box.height; y++) {
        const int64_t pixel = (box.top + y) * args.camera.width + box.left;
        std::memcpy(args.color + 3 * pixel, color, sizeof(R) * size_t(3 * box.width));
        std::memset(args.alpha + pixel, 0, sizeof(R) * size_t(box.width));
        std::memset(args.depth + pixel, 0, sizeof(R) * size_t(box.width));
    }
}

template <class R>
static void draw_tile(const TileArgs<R>& args, int64_t tile, TileEntry<R>* chunk) {
    if (args.begin[tile] == args.begin[tile + 1]) draw_background(args, tile);
    else if (args.settings.compat) draw<R, true>(args, tile, chunk);
    else draw<R, false>(args, tile, chunk);
}

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
