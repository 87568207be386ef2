// The pixels of one tile, composited front to back; tile_gradient.hpp is the backward pass.
// A block of 4x4 pixels is one vector of 16 lanes. Both passes evaluate alpha by the same function.
#pragma once
#include "exponentials.hpp"
#include "tile_masks.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

template <class R> using P = Vec<R, kLanes>;
template <class R> GRAINGS_INLINE P<R> p16(R x) { return splat<R, kLanes>(x); }

// First pixel column and row of each block of a tile.
template <class T>
alignas(64) constexpr T kBlockX[kBlocks] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
template <class T>
alignas(64) constexpr T kBlockY[kBlocks] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};
// Distance of each pixel of a block from the block's centre.
template <class R>
alignas(64) constexpr R kColumns[kLanes] = {-1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5, -1.5, -0.5, 0.5, 1.5};
template <class R>
alignas(64) constexpr R kRows[kLanes] = {-1.5, -1.5, -1.5, -1.5, -0.5, -0.5, -0.5, -0.5, 0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5};

template <class R>
GRAINGS_INLINE void prepare(TileEntry<R>& entry, const Record<R>& record, double left, double top, int64_t number) {
    const double sr = double(record.params.sr), sy = double(record.params.sy), dy = top + 2 - record.y, tilt = sr * record.slope;
    const auto all = [](double x) { return splat<double, kBlocks>(x); };
    const Vec<double, kBlocks> x = load<kBlocks>(kBlockX<double>), y = load<kBlocks>(kBlockY<double>);
    store(entry.r, rounded<R>(fma(all(sr), x, fma(all(-tilt), y, all(sr * ((left + 2 - record.x) - record.slope * dy))))));
    store(entry.s, rounded<R>(fma(all(sy), y, all(sy * dy))));
    store(entry.lanes, fma(p16(record.params.sr), load<kLanes>(kColumns<R>), p16(R(-tilt)) * load<kLanes>(kRows<R>)));
    entry.params = record.params, entry.tilt = R(tilt), entry.number = R(number);
}

// Blocks that a prepared entry may reach, one bit each. Over a block's pixel centres r changes by 1.5 (sr + |tilt|) at
// most and s by 1.5 sy: if the sum of the squares of the remaining |r| and |s| exceeds the record's level, nothing is drawn.
// `margin` covers the rounding errors that are proportional to sr and sy; those proportional to r and s, which are small
// where it matters, are covered by the record's level.
template <class R>
GRAINGS_INLINE uint32_t reached_blocks(const TileEntry<R>& entry) {
    constexpr R margin = R(1.5) + (sizeof(R) == 4 ? R(6e-5) : R(1e-13));
    const P<R> wide = p16(entry.params.sr), rise = p16(entry.params.sy), tilt = abs(p16(entry.tilt)), zero = p16(R(0));
    const P<R> r = max(abs(load<kLanes>(entry.r)) - p16(margin) * (wide + tilt), zero);
    const P<R> s = max(abs(load<kLanes>(entry.s)) - p16(margin) * rise, zero);
    return bits(fma(r, r, s * s) <= p16(entry.params.level));
}

template <class R, int N = kLanes> struct Distance { Vec<R, N> r, s; };

// For N pixels of a block, from the pixel `first` on.
template <int N = kLanes, class R>
GRAINGS_INLINE Distance<R, N> distance(const TileEntry<R>& entry, int block, int first = 0) {
    const auto all = [](R x) { return splat<R, N>(x); };
    return {load<N>(entry.lanes + first) + all(entry.r[block]), fma(all(entry.params.sy), load<N>(kRows<R> + first), all(entry.s[block]))};
}

template <class R, int N>
GRAINGS_INLINE Vec<R, N> uncapped_alpha(const TileEntry<R>& entry, const Distance<R, N>& d) {
    return exp2(fnma(d.r, d.r, fnma(d.s, d.s, splat<R, N>(entry.params.log_opacity))));
}

// Thresholds that decide whether an entry contributes to a pixel. transmittance_min is kept positive, below anything that
// changes a sum in R, because the backward pass divides by the transmittance.
template <class R> struct Thresholds { R alpha_min, alpha_max, transmittance_min; };
template <class R>
GRAINGS_INLINE Thresholds<R> thresholds(const Settings& s) {
    constexpr double faintest = sizeof(R) == 4 ? 1e-30 : 1e-290;
    return {R(s.alpha_min), R(s.alpha_max), R(s.transmittance_min < faintest ? faintest : s.transmittance_min)};
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

// Returns the mask of blocks with a pixel inside the image; open is 1 for every lane inside, else 0.
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

// One compositing step. `light` is the transmittance; a pixel below transmittance_min has stopped and keeps it. In compat
// mode the entry that would cross the threshold is not blended, and `open` is 0 for pixels that have stopped.
template <class R> struct Step {
    P<R> weight;             // of the entry
    Mask<R, kLanes> counts;  // whether the pixel had not stopped
    Mask<R, kLanes> seen;    // and whether the entry's alpha reaches alpha_min
};

template <class R, bool Compat>
GRAINGS_INLINE Step<R> blend(P<R> raw, const Thresholds<R>& thresholds, P<R>& light, P<R>& open) {
    const P<R> zero = p16(R(0)), stop = p16(thresholds.transmittance_min), capped = min(raw, p16(thresholds.alpha_max));
    const auto drawn = p16(thresholds.alpha_min) <= raw;
    if constexpr (Compat) {
        const P<R> alpha = select(drawn & (zero < open), capped, zero), next = light * (p16(R(1)) - alpha);
        open = select(next < stop, zero, open);
        const auto counts = zero < open;
        const P<R> weight = select(counts, alpha * light, zero);
        light = select(counts, next, light);
        return {weight, counts, counts & drawn};
    } else {
        // only one comparison and one product depend on the previous entry
        const P<R> alpha = select(drawn, capped, zero), passed = p16(R(1)) - alpha;
        const auto counts = stop <= light;
        const P<R> weight = select(counts, alpha * light, zero);
        light = select(counts, light * passed, light);
        return {weight, counts, counts & drawn};
    }
}

// Writes the part of one pixel row of a tile that is inside the image.
template <int Channels, class R>
GRAINGS_INLINE void put_row(const R* row, const TileBox& box, int y, int64_t width, R* image) {
    R* to = image + Channels * ((box.top + y) * width + box.left);
    if (box.width == kTile) std::memcpy(to, row, sizeof(R) * Channels * kTile);  // constant size: a few stores
    else std::memcpy(to, row, sizeof(R) * size_t(Channels * box.width));
}

// Converts blocks to rows of pixels.
template <int Channels, class R>
GRAINGS_INLINE void to_rows(const R (*blocks)[kBlocks][kLanes], const TileBox& box, int64_t width, R* image) {
    for (int y = 0; y < box.height; y++) {
        R row[Channels * kTile];
        for (int x = 0; x < kTile; x++)
            for (int c = 0; c < Channels; c++) row[Channels * x + c] = blocks[c][(y >> 2) * 4 + (x >> 2)][(y & 3) * 4 + (x & 3)];
        put_row<Channels>(row, box, y, width, image);
    }
}

constexpr int kSmall = 3;  // entries that touch fewer blocks, on average, are small

template <class R, bool Compat, bool Keep, bool Depth>
GRAINGS_INLINE void draw(const TileArgs<R>& args, int64_t tile, int64_t next_end, TileEntry<R>* chunk) {
    const TileBox box = tile_box(args.camera, tile);
    const Thresholds<R> limits = thresholds<R>(args.settings);
    alignas(64) R open[kBlocks][kLanes], light[kBlocks][kLanes], last[kBlocks][kLanes], channels[4][kBlocks][kLanes];
    uint32_t live = open_lanes(box, open);
    std::memcpy(light, open, sizeof light);
    if constexpr (Keep)
        for (int b = 0; b < kBlocks; b++) store(last[b], p16(R(-1)));
    std::memset(channels, 0, sizeof channels);

    Pair* const pairs = args.pairs;
    uint8_t* const shown = args.shown;  // a copy: the compiler assumes that storing a byte may change `args`
    int64_t k = args.begin[tile];
    const int64_t end = args.begin[tile + 1], start = k, soon_end = args.begin[next_end];
    int32_t items = 0;
    int64_t kept = k;
    while (k < end && live) {
        const int n = int(end - k < kChunk ? end - k : kChunk);
        uint16_t masks[kChunk] = {};
        uint64_t lists[kBlocks];
        int touched = 0;  // (entry, block) pairs
        for (int j = 0; j < n; j++) {
            Pair& pair = pairs[k + j];
            if (k + j + kChunk < soon_end) __builtin_prefetch(&args.records[pairs[k + j + kChunk].id]);  // possibly of the next tile
            if (Keep && shown) __builtin_prefetch(shown + pair.place, 1);
            if (pair.mask &= live) {
                prepare(chunk[j], args.records[pair.id], double(box.left), double(box.top), k + j - start);
                if constexpr (!Compat) pair.mask &= reached_blocks(chunk[j]);
            }
            masks[j] = uint16_t(pair.mask);
            touched += __builtin_popcount(pair.mask);
        }
        items += touched;
        by_block(masks, lists);
        const auto walk = [&](int b, auto watch) {
            [[maybe_unused]] uint64_t unseen = 0;  // entries that no pixel of the block draws
            P<R> t = load<kLanes>(light[b]), going = load<kLanes>(open[b]);
            [[maybe_unused]] P<R> latest = Keep ? load<kLanes>(last[b]) : t;
            P<R> red = load<kLanes>(channels[0][b]), green = load<kLanes>(channels[1][b]);
            P<R> blue = load<kLanes>(channels[2][b]);
            [[maybe_unused]] P<R> depth = Depth ? load<kLanes>(channels[3][b]) : t;
            uint64_t list = lists[b];
            const auto first_of = [&](uint64_t entries) {
                const TileEntry<R>& entry = chunk[__builtin_ctzll(entries)];
                return uncapped_alpha(entry, distance(entry, b));
            };
            P<R> raw = first_of(list);
            for (uint64_t rest; list; list = rest) {
                const int j = __builtin_ctzll(list);
                const TileEntry<R>& entry = chunk[j];
                rest = list & (list - 1);
                const P<R> next = rest ? first_of(rest) : raw;
                const auto [weight, counts, seen] = blend<R, Compat>(raw, limits, t, going);
                if (!any(counts)) break;
                raw = next;
                if constexpr (Keep) latest = select(counts, p16(entry.number), latest);
                if constexpr (watch) unseen |= uint64_t(!any(seen)) << j;
                red = fma(weight, p16(entry.params.red), red);
                green = fma(weight, p16(entry.params.green), green);
                blue = fma(weight, p16(entry.params.blue), blue);
                if constexpr (Depth) depth = fma(weight, p16(entry.params.depth), depth);
            }
            store(light[b], t), store(open[b], going);
            if constexpr (Keep) store(last[b], latest);
            store(channels[0][b], red), store(channels[1][b], green), store(channels[2][b], blue);
            if constexpr (Depth) store(channels[3][b], depth);
            if constexpr (watch) lists[b] &= ~(unseen | list);
            if (any(Compat ? p16(R(0)) < going : p16(limits.transmittance_min) <= t)) return;
            live &= ~(1u << b);  // all its pixels have stopped: the gradient skips the rest
            items -= __builtin_popcountll(list);
            for (; list; list &= list - 1) pairs[k + __builtin_ctzll(list)].mask &= ~(1u << b);
        };
        // Small Gaussians miss all pixel centres of many blocks. Detecting that costs less than evaluating those blocks
        // again in the backward pass.
        if (Keep && touched < kSmall * n) {
            for (int b = 0; b < kBlocks; b++)
                if (lists[b]) walk(b, std::true_type());
            by_entry(lists, masks);
            for (int j = 0; j < n; j++) pairs[k + j].mask = masks[j];
        } else
            for (int b = 0; b < kBlocks; b++)
                if (lists[b]) walk(b, std::false_type());
        if (Keep && shown)  // drawn pairs move to the front of the list
            for (int j = 0; j < n; j++) {
                const Pair pair = pairs[k + j];
                shown[pair.place] = pair.mask != 0;
                pairs[kept] = {uint32_t(k + j - start), pair.id, pair.place, pair.mask};
                kept += pair.mask != 0;
            }
        k += n;
    }
    args.kept[tile] = int32_t(kept - start);
    args.items[tile] = items;
    if (Keep && args.light) {
        std::memcpy(args.light + tile * kBlocks * kLanes, light, sizeof light);
        std::memcpy(args.last + tile * kBlocks * kLanes, last, sizeof last);
    }

    for (int b = 0; b < kBlocks; b++) {
        const P<R> t = load<kLanes>(light[b]);
        for (int c = 0; c < 3; c++) store(channels[c][b], fma(t, p16(args.background[c]), load<kLanes>(channels[c][b])));
        store(light[b], p16(R(1)) - t);
    }
    to_rows<3>(channels, box, args.camera.width, args.color);
    to_rows<1>(&light, box, args.camera.width, args.alpha);
    if constexpr (Depth) to_rows<1>(channels + 3, box, args.camera.width, args.depth);
}

// A tile without entries.
template <class R>
GRAINGS_INLINE void draw_background(const TileArgs<R>& args, int64_t tile) {
    args.kept[tile] = args.items[tile] = 0;
    R color[3 * kTile];
    const R nothing[kTile] = {};
    for (int i = 0; i < 3 * kTile; i++) color[i] = args.background[i % 3];
    const TileBox box = tile_box(args.camera, tile);
    for (int y = 0; y < box.height; y++) {
        put_row<3>(color, box, y, args.camera.width, args.color);
        put_row<1>(nothing, box, y, args.camera.width, args.alpha);
        if (args.depth) put_row<1>(nothing, box, y, args.camera.width, args.depth);
    }
}

template <class R, bool Depth>
GRAINGS_INLINE void draw_some(const TileArgs<R>& args, int64_t tile, int64_t next_end, TileEntry<R>* chunk) {
    if (args.settings.compat) draw<R, true, true, Depth>(args, tile, next_end, chunk);
    else if (args.light) draw<R, false, true, Depth>(args, tile, next_end, chunk);
    else draw<R, false, false, Depth>(args, tile, next_end, chunk);
}

template <class R>
static void draw_tile(const TileArgs<R>& args, int64_t tile, int64_t next_end, TileEntry<R>* chunk) {
    if (args.begin[tile] == args.begin[tile + 1]) draw_background(args, tile);
    else if (args.depth) draw_some<R, true>(args, tile, next_end, chunk);
    else draw_some<R, false>(args, tile, next_end, chunk);
}

}  // namespace graings::GRAINGS_ISA
