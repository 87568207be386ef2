#include "frame.hpp"

#include <algorithm>
#include <bit>
#include <chrono>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "isa.hpp"
#include "pool.hpp"

namespace graings {

namespace {

// Seconds since the last lap.
class Stopwatch {
public:
    double lap() {
        const auto now = std::chrono::steady_clock::now();
        return std::chrono::duration<double>(now - std::exchange(last_, now)).count();
    }

private:
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

constexpr int64_t kPiece = 512;  // Gaussians handed to a thread at a time

int64_t pieces_of(int64_t count, int64_t piece) { return (count + piece - 1) / piece; }

// Numbers of a pixel or tile, cut to [0, end): rounded down, and rounded up.
int64_t below(double x, int64_t end) { return x < 0 ? -1 : x >= double(end) ? end - 1 : int64_t(x); }
int64_t above(double x, int64_t end) {
    if (!(x > 0)) return 0;
    if (x > double(end)) return end;
    const int64_t whole = int64_t(x);
    return whole + (double(whole) < x);
}

// Tiles that a record may touch, row by row: visit(row of tiles, first tile column, last one). `extents` are half the
// width and height of its footprint.
template <class R, class Visit>
void each_tile_row(const Record<R>& record, const Camera& camera, bool compat, const R* radii, const double* extents, Visit visit) {
    if (compat) {
        const int64_t across = pieces_of(camera.width, kTile), down = pieces_of(camera.height, kTile);
        const int64_t x0 = below((record.x - double(radii[0])) / kTile, across), x1 = above((record.x + double(radii[0])) / kTile, across);
        const int64_t y0 = below((record.y - double(radii[1])) / kTile, down), y1 = above((record.y + double(radii[1])) / kTile, down);
        for (int64_t row = std::max<int64_t>(y0, 0); row < y1; row++)
            if (x0 < x1) visit(row, std::max<int64_t>(x0, 0), x1 - 1);
        return;
    }
    // the pixel centres inside the box
    const double widest = extents[0], highest = extents[1];
    const int64_t top = above(record.y - highest - 0.5, camera.height), bottom = below(record.y + highest - 0.5, camera.height);
    const int64_t left = above(record.x - widest - 0.5, camera.width), right = below(record.x + widest - 0.5, camera.width);
    if (!(top <= bottom && left <= right)) return;
    const int64_t first_row = top / kTile, last_row = bottom / kTile, first = left / kTile, last = right / kTile;
    if (last - first < 2 && last_row - first_row < 2) {  // a tighter look would cost more than the tile it saves
        for (int64_t row = first_row; row <= last_row; row++) visit(row, first, last);
        return;
    }
    const double level = double(record.level), steep = record.slope * record.sr;
    const double turn = highest * steep / std::sqrt(steep * steep + record.sy * record.sy);
    for (int64_t row = first_row; row <= last_row; row++) {
        const double low = std::max(double(row * kTile) + 0.5 - record.y, -highest);
        const double high = std::min(double(row * kTile + kTile) - 0.5 - record.y, highest);
        if (low > high) continue;
        const auto edge = [&](double side) {
            const double dy = std::clamp(side * turn, low, high), s = dy * record.sy;
            return record.x + record.slope * dy + side * std::sqrt(std::max(level - s * s, 0.0)) / record.sr;
        };
        const int64_t from = above(edge(-1) - 0.5, camera.width), to = below(edge(1) - 0.5, camera.width);
        if (from <= to) visit(row, from / kTile, to / kTile);
    }
}

}  // namespace

template <class R>
Frame<R>::Frame(const Camera& camera, const Settings& settings, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads)
    : camera_(camera), settings_(settings), count_(in.count),
      tiles_(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)), status_(size_t(in.count)),
      records_(size_t(in.count)), spans_(size_t(in.count)) {
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::invalid_argument("more than 2^32 Gaussians");
    Stopwatch watch;
    Buffer<double> depths{size_t(count_)}, extents{2 * size_t(count_)};
    std::vector<std::vector<uint32_t>> lists{size_t(pieces_of(count_, kPiece))};
    std::vector<int64_t> counts(size_t(tiles_), 0);
    project({camera_, settings_, in, records_.get(), status_.get(), depths.get(), extents.get(), out.means2d, out.radii}, lists, counts, threads);
    seconds_[kProject] = watch.lap();
    const auto order = sorted(depths.get(), uids, threads);
    seconds_[kSort] = watch.lap();
    bin(order, lists, counts, threads);
    seconds_[kBin] = watch.lap();

    const Kernels<R>& run = kernels<R>();
    processed_ = Buffer<int32_t>(size_t(tiles_)), items_ = Buffer<int32_t>(size_t(tiles_));
    TileArgs<R> tiles = tile_args(in.background);
    tiles.color = out.color, tiles.alpha = out.alpha, tiles.depth = out.depth;
    Buffer<TileEntry<R>> chunks(size_t(threads) * kChunk);
    parallel_for(threads, tiles_, [&](int worker, int64_t tile) { run.draw_tile(tiles, tile, chunks.get() + worker * kChunk); });
    seconds_[kBlend] = watch.lap();
}

// Records, and for each piece of Gaussians one list of the tiles they touch; `counts` of them per tile.
template <class R>
void Frame<R>::project(const ProjectArgs<R>& args, std::vector<std::vector<uint32_t>>& lists, std::vector<int64_t>& counts, int threads) {
    const int64_t across = pieces_of(camera_.width, kTile);
    std::vector<std::vector<int64_t>> own{size_t(threads)};
    parallel_for(threads, int64_t(lists.size()), [&](int worker, int64_t piece) {
        const int64_t begin = piece * kPiece, end = std::min(count_, begin + kPiece);
        kernels<R>().project(args, begin, end);
        auto& tiles = lists[size_t(piece)];
        auto& mine = own[size_t(worker)];
        if (mine.empty()) mine.assign(size_t(tiles_), 0);
        tiles.reserve(size_t(3 * (end - begin)));
        for (int64_t i = begin; i < end; i++) {
            Span& span = spans_[size_t(i)] = {uint32_t(tiles.size()), 0, 1, 0};
            if (status_[size_t(i)] != kDrawn) continue;
            each_tile_row(records_[size_t(i)], camera_, settings_.compat, args.radii + 2 * i, args.extents + 2 * i, [&](int64_t row, int64_t from, int64_t to) {
                if (span.first_row > span.last_row) span.first_row = uint32_t(row);
                span.last_row = uint32_t(row);
                for (int64_t tile = row * across + from; tile <= row * across + to; tile++) tiles.push_back(uint32_t(tile)), mine[size_t(tile)]++;
            });
            span.count = uint32_t(tiles.size()) - span.begin;
        }
    });
    for (const auto& mine : own)
        for (size_t tile = 0; tile < mine.size(); tile++) counts[tile] += mine[tile];
}

// Visible Gaussians by (depth, uid): a radix sort on the leading bits of the depth range, then the few runs that
// agree in them by comparison.
template <class R>
std::vector<DepthKey> Frame<R>::sorted(const double* depths, const int64_t* uids, int threads) {
    constexpr int kDigit = 11, kPasses = 2, kBins = 1 << kDigit;
    constexpr int64_t kWorthwhile = 8192;  // fewer are sorted faster than a thread wakes
    const int64_t parts = std::clamp<int64_t>(count_ / kWorthwhile, 1, threads);
    const auto begin = [&](int64_t total, int64_t part) { return total * part / parts; };
    struct Tally {
        int64_t statuses[kStatuses] = {};
        uint64_t least = ~uint64_t(0), most = 0;
    };
    std::vector<Tally> tallies{size_t(parts)};
    const auto bits = [&](int64_t i) { return std::bit_cast<uint64_t>(depths[i]); };  // positive: ordered like the numbers
    parallel_for(threads, parts, [&](int, int64_t part) {
        Tally mine;
        for (int64_t i = begin(count_, part); i < begin(count_, part + 1); i++) {
            mine.statuses[status_[size_t(i)]]++;
            if (status_[size_t(i)] == kDrawn) mine.least = std::min(mine.least, bits(i)), mine.most = std::max(mine.most, bits(i));
        }
        tallies[size_t(part)] = mine;
    });
    uint64_t least = ~uint64_t(0), most = 0;
    std::vector<int64_t> first(size_t(parts) + 1, 0);
    for (int64_t part = 0; part < parts; part++) {
        const Tally& one = tallies[size_t(part)];
        least = std::min(least, one.least), most = std::max(most, one.most);
        for (int k = 0; k < kStatuses; k++) statuses_[k] += one.statuses[k];
        first[size_t(part) + 1] = first[size_t(part)] + one.statuses[kDrawn];
    }
    const int64_t visible = first.back();
    const int shift = visible ? std::max(0, int(std::bit_width(most - least)) - kPasses * kDigit) : 0;
    std::vector<DepthKey> keys{size_t(visible)}, spare{size_t(visible)};
    parallel_for(threads, parts, [&](int, int64_t part) {
        DepthKey* to = keys.data() + first[size_t(part)];
        for (int64_t i = begin(count_, part); i < begin(count_, part + 1); i++)
            if (status_[size_t(i)] == kDrawn) *to++ = {uint32_t((bits(i) - least) >> shift), uint32_t(i)};
    });
    std::vector<uint32_t> at(size_t(parts * kBins));
    for (int pass = 0; pass < kPasses; pass++) {
        const auto digit = [&](const DepthKey& k) { return (k.key >> (kDigit * pass)) & (kBins - 1); };
        parallel_for(threads, parts, [&](int, int64_t part) {
            uint32_t* mine = at.data() + part * kBins;
            std::fill_n(mine, kBins, 0);
            for (int64_t i = begin(visible, part); i < begin(visible, part + 1); i++) mine[digit(keys[size_t(i)])]++;
        });
        uint32_t total = 0;
        for (int bin = 0; bin < kBins; bin++)
            for (int64_t part = 0; part < parts; part++) total += std::exchange(at[size_t(part * kBins + bin)], total);
        parallel_for(threads, parts, [&](int, int64_t part) {
            uint32_t* mine = at.data() + part * kBins;
            for (int64_t i = begin(visible, part); i < begin(visible, part + 1); i++) spare[mine[digit(keys[size_t(i)])]++] = keys[size_t(i)];
        });
        keys.swap(spare);
    }
    const auto before = [&](const DepthKey& a, const DepthKey& b) {
        return std::tuple(depths[a.id], uids[a.id], a.id) < std::tuple(depths[b.id], uids[b.id], b.id);
    };
    for (int64_t i = 0; i < visible;) {
        int64_t j = i + 1;
        while (j < visible && keys[size_t(j)].key == keys[size_t(i)].key) j++;
        if (j > i + 1) std::sort(keys.begin() + i, keys.begin() + j, before);
        i = j;
    }
    return keys;
}

// Every tile's entries in depth order. Threads take bands of tiles and walk all Gaussians, so that none waits for
// another; slots follow the Gaussians' own order, so that their sums are read back in sequence.
template <class R>
void Frame<R>::bin(const std::vector<DepthKey>& order, const std::vector<std::vector<uint32_t>>& lists, const std::vector<int64_t>& counts, int threads) {
    std::vector<int64_t> base(lists.size() + 1, 0);
    for (size_t piece = 0; piece < lists.size(); piece++) base[piece + 1] = base[piece] + int64_t(lists[piece].size());
    pairs_ = base.back();
    if (pairs_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::length_error("more than 2^32 pairs of tile and Gaussian");
    begin_ = Buffer<int64_t>(size_t(tiles_) + 1);
    begin_[0] = 0;
    for (int64_t tile = 0; tile < tiles_; tile++) begin_[size_t(tile) + 1] = begin_[size_t(tile)] + counts[size_t(tile)];
    ids_ = Buffer<uint32_t>(size_t(pairs_)), slots_ = Buffer<uint32_t>(size_t(pairs_)), masks_ = Buffer<uint16_t>(size_t(pairs_));

    const int64_t across = pieces_of(camera_.width, kTile), down = pieces_of(camera_.height, kTile);
    std::vector<int64_t> edges{0};  // bands of rows with about as many pairs each
    for (int64_t row = 1; row < down; row++)
        if (begin_[size_t(row * across)] * threads >= pairs_ * int64_t(edges.size()) && int64_t(edges.size()) < threads) edges.push_back(row);
    edges.push_back(down);
    parallel_for(threads, int64_t(edges.size()) - 1, [&](int, int64_t band) {
        const int64_t first = edges[size_t(band)], last = edges[size_t(band) + 1] - 1;
        std::vector<int64_t> cursor(begin_.get() + first * across, begin_.get() + (last + 1) * across);
        for (size_t k = 0; k < order.size(); k++) {
            if (k + 16 < order.size()) __builtin_prefetch(&spans_[order[k + 16].id]);
            const uint32_t id = order[k].id;
            const Span& span = spans_[id];
            if (int64_t(span.last_row) < first || int64_t(span.first_row) > last) continue;
            const size_t piece = id / kPiece;
            const uint32_t* tiles = lists[piece].data() + span.begin;
            for (uint32_t i = 0; i < span.count; i++) {
                const int64_t tile = int64_t(tiles[i]) - first * across;
                if (tile < 0 || tile >= int64_t(cursor.size())) continue;
                const int64_t entry = cursor[size_t(tile)]++;
                ids_[size_t(entry)] = id, slots_[size_t(entry)] = uint32_t(base[piece]) + span.begin + i;
            }
        }
    });
    for (size_t piece = 0; piece < lists.size(); piece++)
        for (int64_t i = int64_t(piece) * kPiece; i < std::min(count_, (int64_t(piece) + 1) * kPiece); i++) spans_[size_t(i)].begin += uint32_t(base[piece]);
}

template <class R>
TileArgs<R> Frame<R>::tile_args(const R* background) const {
    return {camera_, settings_, background, records_.get(), begin_.get(), ids_.get(), masks_.get(), processed_.get(), items_.get(), nullptr, nullptr, nullptr};
}

template <class R>
int64_t Frame<R>::evaluated() const {
    return std::accumulate(items_.get(), items_.get() + tiles_, int64_t(0)) * kLanes;
}

template <class R>
void Frame<R>::gradient(const Inputs<R>& in, const R* v_color, const R* v_alpha, const R* v_depth, const Gradients<R>& out, int threads) const {
    if (in.count != count_) throw std::invalid_argument("the gradient needs the Gaussians of the forward pass");
    const Kernels<R>& run = kernels<R>();
    Stopwatch watch;
    int64_t entries = 0, items = 0;
    for (int64_t tile = 0; tile < tiles_; tile++)
        entries = std::max<int64_t>(entries, processed_[size_t(tile)]), items = std::max<int64_t>(items, items_[size_t(tile)]);
    struct Scratch {
        Buffer<TileEntry<R>> entries;
        Buffer<int32_t> first_item;
        Buffer<R> alphas, weights;
    };
    std::vector<Scratch> scratch{size_t(threads)};
    Buffer<R> sums(size_t(pairs_) * kSlot);
    Buffer<double> v_background(size_t(tiles_) * 3);
    const TileGradientArgs<R> tiles{tile_args(in.background), slots_.get(), v_color, v_alpha, v_depth, sums.get(), v_background.get()};
    parallel_for(threads, tiles_, [&](int worker, int64_t tile) {
        Scratch& own = scratch[size_t(worker)];
        if (!own.entries.get())
            own = {Buffer<TileEntry<R>>(size_t(entries)), Buffer<int32_t>(size_t(entries)), Buffer<R>(size_t(items) * kLanes), Buffer<R>(size_t(items) * kLanes)};
        run.tile_gradient(tiles, tile, {own.entries.get(), own.first_item.get(), own.alphas.get(), own.weights.get()});
    });
    double ground[3] = {};
    for (int64_t tile = 0; tile < tiles_; tile++)
        for (int c = 0; c < 3; c++) ground[c] += v_background[size_t(3 * tile + c)];
    for (int c = 0; c < 3; c++) out.background[c] = R(ground[c]);
    seconds_[kBlendGradient] = watch.lap();
    const GeometryGradientArgs<R> geometry{camera_, settings_, in, status_.get(), records_.get(), spans_.get(), sums.get(),
                                           out.means, out.quats, out.log_scales, out.opacities, out.colors, out.offset};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        run.geometry_gradient(geometry, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
    seconds_[kGeometryGradient] = watch.lap();
}

template class Frame<float>;
template class Frame<double>;

}  // namespace graings
