// The gradient of one tile's pixels, back to front in one pass. Alpha is evaluated again with the bits of the forward
// pass, so that the transmittance before an entry is the one behind it divided by 1 - alpha; the colour behind an entry
// follows from a convex recurrence.
#pragma once
#include "ranks.hpp"
#include "tiles.hpp"

namespace graings::GRAINGS_ISA {

// Sums that fill a cache line are written with streaming stores: they are not read before all tiles are done, and a line
// that is written completely need not be fetched first.
#if defined(__AVX512F__)
static_assert(kSumStride * sizeof(float) == 64);
template <class R> constexpr bool kStreamed = sizeof(R) == 4;
#else
template <class R> constexpr bool kStreamed = false;
#endif

// A block is processed one register at a time, so that ten sums fit into registers.
template <class R> constexpr int kPart = kNative<R> < kLanes ? kNative<R> : kLanes;

// out[q] = sum of the numbers of v[q], for all sums of an entry at once; writes up to kSumStride numbers.
template <class R>
GRAINGS_INLINE void add_lanes(const Vec<R, kPart<R>> (&v)[kSums], R* out) {
#if defined(__AVX512F__)
    if constexpr (sizeof(R) == 4) {
        // Four steps of pairwise addition, each combining two vectors into one.
        const auto quarters = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xDD)); };
        const auto pairs = [](__m512 a, __m512 b) { return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xDD)); };
        const auto of = [&](int q) { return (__m512)v[q].v; };
        const auto four = [&](int q) { return quarters(quarters(of(q), of(q + 1)), quarters(of(q + 2), of(q + 3))); };
        const __m512 two = quarters(of(8), of(9)), rest = quarters(two, two);
        const __m512 by_four = pairs(pairs(four(0), four(4)), pairs(rest, rest));  // sum q at 4 (q % 4) + q / 4
        const __m512i place = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
        _mm512_stream_ps(out, _mm512_permutexvar_ps(place, by_four));
        return;
    }
#elif defined(__AVX2__)
    if constexpr (sizeof(R) == 4) {
        // Three steps of pairwise addition, each combining two vectors into one.
        const auto pairs = [](__m256 a, __m256 b) { return _mm256_add_ps(_mm256_shuffle_ps(a, b, 0x88), _mm256_shuffle_ps(a, b, 0xDD)); };
        __m256 two[5];
        for (int i = 0; i < 5; i++) two[i] = pairs((__m256)v[2 * i].v, (__m256)v[2 * i + 1].v);
        const __m256 first = pairs(two[0], two[1]), second = pairs(two[2], two[3]), last = pairs(two[4], two[4]);
        _mm256_storeu_ps(out, _mm256_add_ps(_mm256_permute2f128_ps(first, second, 0x20), _mm256_permute2f128_ps(first, second, 0x31)));
        _mm_storeu_ps(out + 8, _mm_add_ps(_mm256_castps256_ps128(last), _mm256_extractf128_ps(last, 1)));
        return;
    }
#endif
    for (int q = 0; q < kSums; q++) out[q] = sum(v[q]);
}

// Converts rows of pixels to blocks; pixels outside the image are 0.
template <int Channels, class R>
GRAINGS_INLINE void to_blocks(const R* image, const TileBox& box, int64_t width, R (*blocks)[kBlocks][kLanes]) {
    for (int y = 0; y < kTile; y++) {
        R edge[Channels * kTile] = {};
        const R* row = edge;
        if (y < box.height) {
            row = image + Channels * ((box.top + y) * width + box.left);
            if (box.width < kTile) std::memcpy(edge, row, sizeof(R) * size_t(Channels * box.width)), row = edge;
        }
        for (int x = 0; x < kTile; x++) {
            const int b = (y >> 2) * 4 + (x >> 2), l = (y & 3) * 4 + (x & 3);
            for (int c = 0; c < Channels; c++) blocks[c][b][l] = row[Channels * x + c];
        }
    }
}

// Whether any number differs from 0; NaN does.
template <class R>
GRAINGS_INLINE bool any_set(const R* numbers) {
    typename Bits<R>::type words[kLanes], all = 0;
    std::memcpy(words, numbers, sizeof words);
    for (int l = 0; l < kLanes; l++) all |= words[l] << 1;  // -0 is 0
    return all != 0;
}

template <class R, bool Extra>
GRAINGS_INLINE void gradient(const TileGradientArgs<R>& all, int64_t tile) {
    const TileArgs<R>& args = all.tiles;
    const int64_t begin = args.begin[tile], end = args.begin[tile + 1];
    double* tile_v_background = all.v_background ? all.v_background + 3 * tile : nullptr;
    if (tile_v_background) tile_v_background[0] = tile_v_background[1] = tile_v_background[2] = 0;
    if (begin == end && !tile_v_background) return;
    const TileBox box = tile_box(args.camera, tile);
    const Thresholds<R> limits = thresholds<R>(args.settings);
    const P<R> zero = p16(R(0));

    // gradient of the loss with respect to colour, alpha and depth
    constexpr int kChannels = Extra ? 5 : 3;
    alignas(64) R up[5][kBlocks][kLanes];
    to_blocks<3>(all.v_color, box, args.camera.width, up);
    if constexpr (Extra) {
        std::memset(up[3], 0, 2 * sizeof up[3]);
        if (all.v_alpha) to_blocks<1>(all.v_alpha, box, args.camera.width, up + 3);
        if (all.v_depth) to_blocks<1>(all.v_depth, box, args.camera.width, up + 4);
    }
    uint32_t active = 0;  // blocks with a non-zero upstream gradient
    for (int b = 0; b < kBlocks; b++)
        for (int c = 0; c < kChannels; c++) active |= uint32_t(any_set(up[c][b])) << b;

    const auto sums_of = [&](uint32_t place) { return all.sums + size_t(rank(all.ranks, place)) * kSumStride; };
    const auto put_zeros = [&](uint32_t place) { std::memset(sums_of(place), 0, kSums * sizeof(R)); };
    const int n = args.kept[tile];
    if (!active) {
        for (int64_t k = begin; k < begin + n; k++) put_zeros(args.pairs[k].place);
        return;
    }

    // the value behind the current entry, multiplied by the upstream gradient; starts at the background
    alignas(64) R light[kBlocks][kLanes], behind[kBlocks][kLanes];
    if (begin == end) open_lanes(box, light);  // no entries: the forward pass has stored nothing
    else std::memcpy(light, args.light + tile * kBlocks * kLanes, sizeof light);
    const R(*last)[kLanes] = reinterpret_cast<const R(*)[kLanes]>(args.last + tile * kBlocks * kLanes);
    for (int b = 0; b < kBlocks; b++) {
        P<R> ground = zero;
        for (int c = 0; c < 3; c++) {
            const P<R> g = load<kLanes>(up[c][b]);
            ground = fma(g, p16(args.background[c]), ground);
            if (tile_v_background) tile_v_background[c] += double(sum(g * load<kLanes>(light[b])));
        }
        store(behind[b], ground);
    }

    constexpr int N = kPart<R>;
    using Part = Vec<R, N>;
    const auto all_of = [](R x) { return splat<R, N>(x); };
    const Part none = all_of(R(0));
    struct Evaluated {  // one register of an entry's block
        Part raw;  // alpha before its cap
        Distance<R, N> at;
        int block, first;
    };
    const auto evaluate = [&](const TileEntry<R>& entry, uint32_t mask, int first) {
        const int b = __builtin_ctz(mask);
        const Distance<R, N> at = distance<N>(entry, b, first);
        return Evaluated{uncapped_alpha(entry, at), at, b, first};
    };
    struct Totals {
        Part e, er, es, err, ers, ess, red, green, blue, depth;
    };
    const auto add = [&](Totals& total, const TileEntry<R>& entry, const Evaluated& evaluated) {
        const auto of = [&](R (*lanes)[kLanes]) { return lanes[evaluated.block] + evaluated.first; };
        const auto counts = (all_of(limits.alpha_min) <= evaluated.raw) & (all_of(entry.number) <= load<N>(last[evaluated.block] + evaluated.first));
        const Part alpha = select(counts, min(evaluated.raw, all_of(limits.alpha_max)), none);
        const Part before = load<N>(of(light)) / (all_of(R(1)) - alpha), weight = alpha * before;
        store(of(light), before);
        const Part g0 = load<N>(of(up[0])), g1 = load<N>(of(up[1])), g2 = load<N>(of(up[2]));
        Part own = fma(g0, all_of(entry.params.red), fma(g1, all_of(entry.params.green), g2 * all_of(entry.params.blue)));
        if constexpr (Extra) {
            const Part g4 = load<N>(of(up[4]));
            own = fma(g4, all_of(entry.params.depth), own + load<N>(of(up[3])));
            total.depth = fma(weight, g4, total.depth);
        }
        const Part back = load<N>(of(behind)), gain = own - back;
        store(of(behind), fma(alpha, gain, back));
        const Part ge = select(evaluated.raw <= all_of(limits.alpha_max), weight * gain, none);  // no gradient through capped alpha
        const Part ge_r = ge * evaluated.at.r, ge_s = ge * evaluated.at.s;
        total.e = total.e + ge, total.er = total.er + ge_r, total.es = total.es + ge_s;
        total.err = fma(ge_r, evaluated.at.r, total.err), total.ers = fma(ge_r, evaluated.at.s, total.ers), total.ess = fma(ge_s, evaluated.at.s, total.ess);
        total.red = fma(weight, g0, total.red), total.green = fma(weight, g1, total.green), total.blue = fma(weight, g2, total.blue);
    };

    // How many entries in advance records and sums are prefetched, and entries are prepared.
    constexpr int kRecordAhead = 32, kSumsAhead = 16, kReadyAhead = 8;
    // Ring of prepared entries, only of those with an active block, so that the entry evaluated last stays valid until it
    // is added, however many inactive entries follow it.
    constexpr int kReady = 16;
    static_assert(kReady > kReadyAhead + 1);
    TileEntry<R> ready[kReady];
    int readied = 0, taken = 0;
    const Pair* entries = args.pairs + begin;
    const auto record_of = [&](int j) -> const Record<R>& { return args.records[entries[j].id]; };

    const auto make_ready = [&](int j) {
        if (entries[j].mask & active) prepare(ready[readied++ % kReady], record_of(j), double(box.left), double(box.top), entries[j].key);
    };
    for (int j = n - 1; j >= 0 && j > n - 1 - kReadyAhead; j--) make_ready(j);

    const auto clear = [&](Totals& t) { t.e = t.er = t.es = t.err = t.ers = t.ess = t.red = t.green = t.blue = t.depth = none; };
    const auto put = [&](const Totals& total, int j) {
        const Part totals[kSums] = {total.e, total.er, total.es, total.err, total.ers, total.ess, total.red, total.green, total.blue, Extra ? total.depth : none};
        add_lanes(totals, sums_of(entries[j].place));
    };
    // With enough registers, the next block is evaluated before the last one is added, so that their dependency chains
    // overlap.
    constexpr bool kOverlap = kOne<R, kLanes>;
    Totals total;
    clear(total);
    [[maybe_unused]] Evaluated evaluated;
    const TileEntry<R>* latest = nullptr;  // entry of the block evaluated last
    int open = -1;                         // and its index; -1: none
    const auto close = [&] {
        add(total, *latest, evaluated);
        put(total, open);
    };
    for (int j = n - 1; j >= 0; j--) {
        if (j >= kRecordAhead) __builtin_prefetch(&record_of(j - kRecordAhead));
        if (j >= kReadyAhead) make_ready(j - kReadyAhead);
        if (!kStreamed<R> && j >= kSumsAhead) __builtin_prefetch(sums_of(entries[j - kSumsAhead].place), 1);
        uint32_t mask = entries[j].mask & active;
        if (!mask) {
            put_zeros(entries[j].place);
            continue;
        }
        const TileEntry<R>& entry = ready[taken++ % kReady];
        if constexpr (kOverlap) {
            Evaluated next = evaluate(entry, mask, 0);
            if (open >= 0) close();
            open = j, latest = &entry, evaluated = next, clear(total);
            while (mask &= mask - 1) {
                next = evaluate(entry, mask, 0);
                add(total, entry, evaluated);
                evaluated = next;
            }
        } else {
            clear(total);
            for (; mask; mask &= mask - 1)
                for (int first = 0; first < kLanes; first += N) add(total, entry, evaluate(entry, mask, first));
            put(total, j);
        }
    }
    if (open >= 0) close();
#if defined(__AVX512F__)
    if constexpr (kStreamed<R>) _mm_sfence();  // streaming stores must be visible before the tile is reported as done
#endif
}

template <class R>
static void tile_gradient(const TileGradientArgs<R>& args, int64_t tile) {
    if (args.v_alpha || args.v_depth) gradient<R, true>(args, tile);
    else gradient<R, false>(args, tile);
}

}  // namespace graings::GRAINGS_ISA
