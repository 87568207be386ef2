// The pixels of one tile: compositing front to back, and its gradient back to front.
// A block of 4x4 pixels is one vector of 16 lanes. Both directions evaluate alpha by the same function.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

template <class R> using P = Vec<R, kLanes>;
template <class R> GRAINGS_INLINE P<R> p16(R x) { return splat<R, kLanes>(x); }

GRAINGS_INLINE double at_least(double a, double b) { return a > b ? a : b; }
GRAINGS_INLINE double at_most(double a, double b) { return a < b ? a : b; }

// Blocks of the tile at (left, top) that the ellipse of `record` reaches: bit 4 * row + column.
// Per row of blocks the ellipse is cut at the row's first and last pixel centres; there its largest x is
// exact, because slope * dy + half-width(dy) is concave.
template <class R>
GRAINGS_INLINE uint32_t block_mask(const Record<R>& record, double left, double top) {
    const double level = double(record.level), steep = record.slope * record.sr;
    const double highest = __builtin_sqrt(level) / record.sy;
    const double turn = highest * steep / __builtin_sqrt(steep * steep + record.sy * record.sy);
    const double x0 = record.x - left, y0 = record.y - top;
    // lanes: the four rows of blocks to the right of the mean, then the same rows to the left
    using V = Vec<double, 8>;
    alignas(64) static constexpr double kFirstRow[8] = {0.5, 4.5, 8.5, 12.5, 0.5, 4.5, 8.5, 12.5};
    alignas(64) static constexpr double kSide[8] = {1, 1, 1, 1, -1, -1, -1, -1};
    const V side = load<8>(kSide), first_row = load<8>(kFirstRow) - splat<double, 8>(y0);
    const V from = max(first_row, splat<double, 8>(-highest)), to = min(first_row + splat<double, 8>(3), splat<double, 8>(highest));
    const V dy = clamp(side * splat<double, 8>(turn), from, to);
    const V scaled = dy * splat<double, 8>(record.sy);
    const V room = max(splat<double, 8>(level) - scaled * scaled, splat<double, 8>(0));
    const V edge = splat<double, 8>(x0) + splat<double, 8>(record.slope) * dy + side * sqrt(room) * splat<double, 8>(1 / record.sr);
    // a block column b holds the pixel centres 4b + 0.5 ... 4b + 3.5
    double columns[8];
    store(columns, clamp((edge - select(splat<double, 8>(0) < side, splat<double, 8>(0.5), splat<double, 8>(3.5))) * splat<double, 8>(0.25),
                         splat<double, 8>(-2), splat<double, 8>(5)));
    double low[8], high[8];
    store(low, from), store(high, to);
    uint32_t mask = 0;
    for (int row = 0; row < 4; row++) {
        if (!(low[row] <= high[row])) continue;
        const int last = int(__builtin_floor(columns[row]));
        int first = int(__builtin_ceil(columns[4 + row]));
        if (first < 0) first = 0;
        if (first > last || last < 0 || first > 3) continue;
        const uint32_t bits = ((2u << (last > 3 ? 3 : last)) - 1) & ~((1u << first) - 1);
        mask |= bits << (4 * row);
    }
    return mask;
}

// Scaled distances are rounded to R only here, relative to the block, so that they stay accurate however far
// the mean is and however long the needle.
template <class R>
GRAINGS_INLINE void prepare(TileEntry<R>& entry, const Record<R>& record, double left, double top) {
    const double tilt = record.sr * record.slope;
    const double dy = top + 2 - record.y;
    const double r = record.sr * ((left + 2 - record.x) - record.slope * dy), s = record.sy * dy;
    const R sr = R(record.sr), lean = R(tilt);
    for (int row = 0; row < 4; row++) {
        entry.center_s[row] = R(s + record.sy * (4 * row));
        for (int column = 0; column < 4; column++) {
            entry.center_r[4 * row + column] = R(r + record.sr * (4 * column) - tilt * (4 * row));
            entry.spread[4 * row + column] = sr * R(column - 1.5) - lean * R(row - 1.5);
        }
    }
    entry.sy = R(record.sy), entry.opacity = record.opacity, entry.depth = record.depth;
    entry.red = record.red, entry.green = record.green, entry.blue = record.blue;
}

alignas(64) constexpr double kRows[kLanes] = {-1.5, -1.5, -1.5, -1.5, -0.5, -0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5};
template <class R>
GRAINGS_INLINE P<R> lane_rows() {
    R rows[kLanes];
    for (int i = 0; i < kLanes; i++) rows[i] = R(kRows[i]);
    return load<kLanes>(rows);
}

template <class R> struct Distance { P<R> r, s; };

template <class R>
GRAINGS_INLINE Distance<R> distance(const TileEntry<R>& entry, int block, P<R> rows) {
    return {load<kLanes>(entry.spread) + p16(entry.center_r[block]), fma(rows, p16(entry.sy), p16(entry.center_s[block >> 2]))};
}

template <class R>
GRAINGS_INLINE P<R> uncapped_alpha(const TileEntry<R>& entry, const Distance<R>& d) {
    return p16(entry.opacity) * exp2_minus(fma(d.r, d.r, d.s * d.s));
}

template <class R> struct Rule { R alpha_min, alpha_max, transmittance_min; };
template <class R>
GRAINGS_INLINE Rule<R> rule(const Settings& s) { return {R(s.alpha_min), R(s.alpha_max), R(s.transmittance_min)}; }

template <class R>
GRAINGS_INLINE P<R> drawn_alpha(P<R> raw, const Rule<R>& rule) {
    return select(p16(rule.alpha_min) <= raw, min(raw, p16(rule.alpha_max)), p16(R(0)));
}

// One step of light through a pixel. `open` is the transmittance, 0 once the pixel has stopped; `left` is what
// finally reaches the background. Returns the blending weight.
template <class R, bool Compat>
GRAINGS_INLINE P<R> blend(P<R> alpha, const Rule<R>& rule, P<R>& open, P<R>& left) {
    const P<R> zero = p16(R(0));
    P<R> weight = alpha * open;
    const P<R> next = open * (p16(R(1)) - alpha);
    const auto stops = next < p16(rule.transmittance_min);
    if constexpr (Compat) {  // the one that would cross is left out
        left = select(stops, left, next);
        weight = select(stops, zero, weight);
    } else {
        left = select(zero < open, next, left);
    }
    open = select(stops, zero, next);
    return weight;
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
    const P<R> rows = lane_rows<R>();
    alignas(64) R open[kBlocks][kLanes], left[kBlocks][kLanes], channels[4][kBlocks][kLanes];
    uint32_t live = open_lanes(box, open);
    std::memcpy(left, open, sizeof left);
    std::memset(channels, 0, sizeof channels);

    int64_t k = args.begin[tile];
    const int64_t end = args.begin[tile + 1], start = k;
    int32_t items = 0;
    while (k < end && live) {
        const int n = int(end - k < kChunk ? end - k : kChunk);
        uint32_t masks[kChunk];
        for (int j = 0; j < n; j++) {
            if (k + j + 8 < end) __builtin_prefetch(&args.records[args.ids[k + j + 8]]);
            const Record<R>& record = args.records[args.ids[k + j]];
            masks[j] = (Compat ? 0xFFFFu : block_mask(record, double(box.left), double(box.top))) & live;
            args.masks[k + j] = uint16_t(masks[j]);
            items += __builtin_popcount(masks[j]);
            if (masks[j]) prepare(chunk[j], record, double(box.left), double(box.top));
        }
        k += n;
        for (int b = 0; b < kBlocks; b++) {
            if (!(live >> b & 1)) continue;
            int list[kChunk], count = 0;
            for (int j = 0; j < n; j++) list[count] = j, count += masks[j] >> b & 1;
            if (count == 0) continue;
            P<R> t = load<kLanes>(open[b]), rest = load<kLanes>(left[b]);
            P<R> red = load<kLanes>(channels[0][b]), green = load<kLanes>(channels[1][b]);
            P<R> blue = load<kLanes>(channels[2][b]), depth = load<kLanes>(channels[3][b]);
            for (int i = 0; i < count; i++) {
                const TileEntry<R>& entry = chunk[list[i]];
                const P<R> alpha = drawn_alpha(uncapped_alpha(entry, distance(entry, b, rows)), limits);
                const P<R> weight = blend<R, Compat>(alpha, limits, t, rest);
                red = fma(weight, p16(entry.red), red);
                green = fma(weight, p16(entry.green), green);
                blue = fma(weight, p16(entry.blue), blue);
                depth = fma(weight, p16(entry.depth), depth);
            }
            store(open[b], t), store(left[b], rest);
            store(channels[0][b], red), store(channels[1][b], green), store(channels[2][b], blue), store(channels[3][b], depth);
            if (!any(p16(R(0)) < t)) live &= ~(1u << b);
        }
    }
    args.processed[tile] = int32_t(k - start);
    args.items[tile] = items;

    const R ground[3] = {args.background[0], args.background[1], args.background[2]};
    for (int b = 0; b < kBlocks; b++)
        for (int l = 0; l < kLanes; l++) {
            const int x = lane_x(b, l), y = lane_y(b, l);
            if (x >= box.width || y >= box.height) continue;
            const int64_t pixel = (box.top + y) * args.camera.width + box.left + x;
            const R t = left[b][l];
            for (int c = 0; c < 3; c++) args.color[3 * pixel + c] = channels[c][b][l] + t * ground[c];
            args.alpha[pixel] = R(1) - t;
            args.depth[pixel] = channels[3][b][l];
        }
}

template <class R>
static void draw_tile(const TileArgs<R>& args, int64_t tile, TileEntry<R>* chunk) {
    if (args.settings.compat) draw<R, true>(args, tile, chunk);
    else draw<R, false>(args, tile, chunk);
}

template <class R, bool Compat, bool Extra>
GRAINGS_INLINE void gradient(const TileGradientArgs<R>& all, int64_t tile, const TileScratch<R>& scratch) {
    const TileArgs<R>& args = all.tiles;
    const TileBox box = tile_box(args.camera, tile);
    const Rule<R> limits = rule<R>(args.settings);
    const P<R> rows = lane_rows<R>(), zero = p16(R(0));
    const int64_t begin = args.begin[tile], end = args.begin[tile + 1];
    double* v_ground = all.v_background + 3 * tile;
    v_ground[0] = v_ground[1] = v_ground[2] = 0;

    // upstream: colour, then alpha, then depth
    alignas(64) R up[5][kBlocks][kLanes];
    bool silent = true;
    for (int b = 0; b < kBlocks; b++)
        for (int l = 0; l < kLanes; l++) {
            const int x = lane_x(b, l), y = lane_y(b, l);
            const bool inside = x < box.width && y < box.height;
            const int64_t pixel = (box.top + y) * args.camera.width + box.left + x;
            for (int c = 0; c < 3; c++) up[c][b][l] = inside ? all.v_color[3 * pixel + c] : R(0);
            up[3][b][l] = Extra && inside && all.v_alpha ? all.v_alpha[pixel] : R(0);
            up[4][b][l] = Extra && inside && all.v_depth ? all.v_depth[pixel] : R(0);
            for (int c = 0; c < 5; c++) silent &= up[c][b][l] == R(0);
        }
    if (silent) {
        for (int64_t k = begin; k < end; k++) std::memset(all.sums + all.slots[k] * kSums, 0, sizeof(R) * kSums);
        return;
    }

    // forward again, to keep alpha and weight of every (entry, block)
    alignas(64) R open[kBlocks][kLanes], left[kBlocks][kLanes], behind[kBlocks][kLanes];
    open_lanes(box, open);
    std::memcpy(left, open, sizeof left);
    const int n = args.processed[tile];
    int32_t item = 0;
    for (int j = 0; j < n; j++) {
        scratch.first_item[j] = item;
        uint32_t mask = args.masks[begin + j];
        if (!mask) continue;
        if (j + 8 < n) __builtin_prefetch(&args.records[args.ids[begin + j + 8]]);
        TileEntry<R>& entry = scratch.entries[j];
        prepare(entry, args.records[args.ids[begin + j]], double(box.left), double(box.top));
        for (; mask; mask &= mask - 1, item++) {
            const int b = __builtin_ctz(mask);
            P<R> t = load<kLanes>(open[b]), rest = load<kLanes>(left[b]);
            const P<R> was_open = t;
            const P<R> raw = uncapped_alpha(entry, distance(entry, b, rows));
            const P<R> alpha = drawn_alpha(raw, limits);
            const P<R> weight = blend<R, Compat>(alpha, limits, t, rest);
            store(open[b], t), store(left[b], rest);
            // a stopped lane behaves as if the entry were not there
            P<R> kept = select(zero < was_open, alpha, zero);
            if constexpr (Compat) kept = select(zero < weight, alpha, zero);
            store(scratch.alphas + int64_t(item) * kLanes, kept);
            store(scratch.weights + int64_t(item) * kLanes, select(p16(limits.alpha_max) < raw, zero - weight, weight));
        }
    }

    // what a pixel sees behind the current entry, weighed by its upstream: starts at the background
    for (int b = 0; b < kBlocks; b++) {
        const P<R> t = load<kLanes>(left[b]);
        P<R> sum_ = zero;
        for (int c = 0; c < 3; c++) {
            const P<R> g = load<kLanes>(up[c][b]);
            sum_ = fma(g, p16(args.background[c]), sum_);
            v_ground[c] += double(sum(g * t));
        }
        store(behind[b], sum_);
    }

    for (int64_t k = begin + n; k < end; k++) std::memset(all.sums + all.slots[k] * kSums, 0, sizeof(R) * kSums);
    for (int j = n - 1; j >= 0; j--) {
        R* slot = all.sums + all.slots[begin + j] * kSums;
        uint32_t mask = args.masks[begin + j];
        if (!mask) {
            std::memset(slot, 0, sizeof(R) * kSums);
            continue;
        }
        const TileEntry<R>& entry = scratch.entries[j];
        const R* alphas = scratch.alphas + int64_t(scratch.first_item[j]) * kLanes;
        const R* weights = scratch.weights + int64_t(scratch.first_item[j]) * kLanes;
        P<R> e = zero, er = zero, es = zero, err = zero, ers = zero, ess = zero;
        P<R> red = zero, green = zero, blue = zero, depth = zero;
        for (; mask; mask &= mask - 1, alphas += kLanes, weights += kLanes) {
            const int b = __builtin_ctz(mask);
            const Distance<R> d = distance(entry, b, rows);
            const P<R> alpha = load<kLanes>(alphas), signed_weight = load<kLanes>(weights);
            const P<R> passing = max(signed_weight, zero);            // capped alpha passes no gradient
            const P<R> weight = max(signed_weight, zero - signed_weight);
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
        const P<R> totals[kSums] = {e, er, es, err, ers, ess, red, green, blue, depth};
        for (int q = 0; q < kSums; q++) slot[q] = sum(totals[q]);
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
