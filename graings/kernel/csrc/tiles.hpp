// The pixels of one tile, composited front to back; tile_gradient.hpp goes back to front.
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

}  // namespace graings::GRAINGS_ISA
