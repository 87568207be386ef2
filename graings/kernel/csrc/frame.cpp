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

constexpr int64_t kMostEntries = 1 << 24;  // of a tile: their numbers are kept in R
constexpr int64_t kPiece = 512;  // Gaussians handed to a thread at a time

int64_t pieces_of(int64_t count, int64_t piece) { return (count + piece - 1) / piece; }

// Neighbours share Gaussians: a thread takes a few tiles at a time.
template <class Visit>
void each_tile(int threads, int64_t tiles, Visit visit) {
    constexpr int64_t kTogether = 4;
    parallel_for(threads, pieces_of(tiles, kTogether), [&](int worker, int64_t piece) {
        for (int64_t tile = piece * kTogether; tile < std::min(tiles, (piece + 1) * kTogether); tile++) visit(worker, tile);
    });
}

uint64_t bits_of_depth(double depth) { return std::bit_cast<uint64_t>(depth); }  // positive: ordered like the numbers

// Tiles that a record may touch, row by row: visit(row of tiles, first tile column, last one).
template <class R, class Visit>
void each_tile_row(const Record<R>& record, const Span& span, int64_t width, Visit visit) {
    const double sr = double(record.look.sr), sy = double(record.look.sy), level = double(record.look.level), steep = record.slope * sr;
    const double highest = std::sqrt(level) / sy, turn = highest * steep / std::sqrt(steep * steep + sy * sy);
    for (uint32_t row = span.top; row <= span.bottom; row++) {
        const double low = std::max(double(row * kTile) + 0.5 - record.y, -highest);
        const double high = std::min(double(row * kTile + kTile) - 0.5 - record.y, highest);
        if (low > high) continue;
        const auto edge = [&](double side) {
            const double dy = std::clamp(side * turn, low, high), s = dy * sy;
            return record.x + record.slope * dy + side * std::sqrt(std::max(level - s * s, 0.0)) / sr;
        };
        // the pixel centres inside
        const double from = std::ceil(std::max(edge(-1) - 0.5, 0.0)), to = std::floor(std::min(edge(1) - 0.5, double(width) - 1));
        if (from > to) continue;
        const uint32_t first = std::max(uint32_t(from) / kTile, span.left), last = std::min(uint32_t(to) / kTile, span.right);
        if (first <= last) visit(row, first, last);
    }
}

// A tighter look at so few tiles would cost more than the tiles it saves.
bool is_small(const Span& span) { return span.count <= 16; }

}  // namespace

template <class R>
Frame<R>::Frame(const Camera& camera, const Settings& settings, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads, bool gradient)
    : camera_(camera), settings_(settings), count_(in.count),
      tiles_(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)), status_(size_t(in.count)),
      records_(size_t(in.count)), spans_(size_t(in.count)) {
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::invalid_argument("more than 2^32 Gaussians");
    Stopwatch watch;
    Buffer<double> depths{size_t(count_)};
    const auto pieces = project({camera_, settings_, in, records_.get(), status_.get(), depths.get(), spans_.get(), out.means2d, out.radii}, threads);
    seconds_[kProject] = watch.lap();
    const auto order = sorted(pieces, depths.get(), uids, threads);
    seconds_[kSort] = watch.lap();
    bin(order, threads);
    seconds_[kBin] = watch.lap();

    const Kernels<R>& run = kernels<R>();
    processed_ = Buffer<int32_t>(size_t(tiles_)), items_ = Buffer<int32_t>(size_t(tiles_));
    if (gradient) light_ = Buffer<R>(size_t(tiles_) * kBlocks * kLanes), last_ = Buffer<R>(size_t(tiles_) * kBlocks * kLanes);
    TileArgs<R> tiles = tile_args(in.background);
    tiles.color = out.color, tiles.alpha = out.alpha, tiles.depth = out.depth;
    Buffer<TileEntry<R>> chunks(size_t(threads) * kChunk);
    each_tile(threads, tiles_, [&](int worker, int64_t tile) { run.draw_tile(tiles, tile, chunks.get() + worker * kChunk); });
    seconds_[kBlend] = watch.lap();
}

// Records and spans; `begin_` holds where the pairs of each tile begin.
template <class R>
std::vector<Piece> Frame<R>::project(const ProjectArgs<R>& args, int threads) {
    const size_t across = size_t(pieces_of(camera_.width, kTile));
    std::vector<std::vector<uint32_t>> counts{size_t(threads)};
    std::vector<Piece> pieces{size_t(pieces_of(count_, kPiece))};
    parallel_for(threads, int64_t(pieces.size()), [&](int worker, int64_t index) {
        Piece piece{index * kPiece, std::min(count_, (index + 1) * kPiece)};
        kernels<R>().project(args, piece.begin, piece.end);
        auto& mine = counts[size_t(worker)];
        if (mine.empty()) mine.assign(size_t(tiles_), 0);
        uint32_t* tile = mine.data();
        for (int64_t i = piece.begin; i < piece.end; i++) {
            piece.statuses[status_[size_t(i)]]++;
            Span& span = spans_[size_t(i)];
            if (span.count == 0) continue;
            if (settings_.compat || is_small(span)) {
                for (size_t row = span.top; row <= span.bottom; row++)
                    for (size_t column = span.left; column <= span.right; column++) tile[row * across + column]++;
            } else {
                span.count = 0;
                each_tile_row(records_[size_t(i)], span, camera_.width, [&](size_t row, uint32_t from, uint32_t to) {
                    span.count += to - from + 1;
                    for (size_t column = from; column <= to; column++) tile[row * across + column]++;
                });
                if (span.count == 0) continue;
            }
            span.begin = uint32_t(piece.pairs), piece.pairs += span.count, piece.tiled++;
            const uint64_t depth = bits_of_depth(args.depths[i]);
            piece.least = std::min(piece.least, depth), piece.most = std::max(piece.most, depth);
        }
        pieces[size_t(index)] = piece;
    });
    for (const Piece& piece : pieces) {
        pairs_ += piece.pairs;
        for (int k = 0; k < kStatuses; k++) statuses_[k] += piece.statuses[k];
    }
    if (pairs_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::length_error("more than 2^32 pairs of tile and Gaussian");
    begin_ = Buffer<int64_t>(size_t(tiles_) + 1);
    begin_[0] = 0;
    for (size_t tile = 0; tile < size_t(tiles_); tile++) {
        begin_[tile + 1] = begin_[tile];
        for (const auto& mine : counts)
            if (!mine.empty()) begin_[tile + 1] += mine[tile];
        if (begin_[tile + 1] - begin_[tile] > kMostEntries) throw std::length_error("more than 2^24 Gaussians on one tile");
    }
    return pieces;
}

// Gaussians with tiles by (depth, uid): a radix sort on the leading bits of the depth range, then the few runs that
// agree in them by comparison. Their pairs are numbered on the way, in the Gaussians' own order.
template <class R>
Buffer<DepthKey> Frame<R>::sorted(const std::vector<Piece>& pieces, const double* depths, const int64_t* uids, int threads) {
    constexpr int kDigit = 12, kPasses = 2, kBins = 1 << kDigit, kKey = 32, kRest = kKey - kPasses * kDigit;
    constexpr int64_t kWorthwhile = 8192;  // fewer are sorted faster than a thread wakes
    uint64_t least = ~uint64_t(0), most = 0;
    std::vector<int64_t> key_at, slot_at;  // of each piece
    int64_t pairs = 0;
    for (const Piece& piece : pieces) {
        key_at.push_back(tiled_), slot_at.push_back(pairs);
        tiled_ += piece.tiled, pairs += piece.pairs;
        least = std::min(least, piece.least), most = std::max(most, piece.most);
    }
    const int64_t parts = std::clamp<int64_t>(tiled_ / kWorthwhile, 1, threads);
    const int spare_bits = tiled_ ? kKey - int(std::bit_width(most - least)) : 0;  // left-aligned: the leading digits tell most
    const auto key = [&](double depth) {
        const uint64_t above = bits_of_depth(depth) - least;
        return uint32_t(spare_bits < 0 ? above >> -spare_bits : above << spare_bits);
    };
    Buffer<DepthKey> keys{size_t(tiled_)}, spare{size_t(tiled_)};
    parallel_for(int(parts), int64_t(pieces.size()), [&](int, int64_t index) {
        const Piece& piece = pieces[size_t(index)];
        DepthKey* to = keys.get() + key_at[size_t(index)];
        for (int64_t i = piece.begin; i < piece.end; i++) {
            Span& span = spans_[size_t(i)];
            span.begin += uint32_t(slot_at[size_t(index)]);
            if (span.count > 0) *to++ = {key(depths[i]), uint32_t(i)};
        }
    });
    const auto begin = [&](int64_t part) { return tiled_ * part / parts; };
    std::vector<uint32_t> at(size_t(parts * kBins));
    for (int pass = 0; pass < kPasses; pass++) {
        const auto digit = [&](const DepthKey& k) { return (k.key >> (kRest + kDigit * pass)) & (kBins - 1); };
        parallel_for(threads, parts, [&](int, int64_t part) {
            uint32_t* mine = at.data() + part * kBins;
            std::fill_n(mine, kBins, 0);
            for (int64_t i = begin(part); i < begin(part + 1); i++) mine[digit(keys[size_t(i)])]++;
        });
        uint32_t total = 0;
        for (int bin = 0; bin < kBins; bin++)
            for (int64_t part = 0; part < parts; part++) total += std::exchange(at[size_t(part * kBins + bin)], total);
        parallel_for(threads, parts, [&](int, int64_t part) {
            uint32_t* mine = at.data() + part * kBins;
            for (int64_t i = begin(part); i < begin(part + 1); i++) spare[mine[digit(keys[size_t(i)])]++] = keys[size_t(i)];
        });
        std::swap(keys, spare);
    }
    const auto before = [&](const DepthKey& a, const DepthKey& b) {
        if (a.key != b.key) return a.key < b.key;
        return std::tuple(depths[a.id], uids[a.id], a.id) < std::tuple(depths[b.id], uids[b.id], b.id);
    };
    for (int64_t i = 0; i < tiled_;) {
        int64_t j = i + 1;
        while (j < tiled_ && keys[size_t(j)].key >> kRest == keys[size_t(i)].key >> kRest) j++;
        if (j > i + 1) std::sort(keys.get() + i, keys.get() + j, before);
        i = j;
    }
    return keys;
}

// Every tile's entries in depth order. Threads take bands of tiles and walk all Gaussians, so that none waits for
// another; slots follow the Gaussians' own order, so that their sums are read back in sequence.
template <class R>
void Frame<R>::bin(const Buffer<DepthKey>& order, int threads) {
    ids_ = Buffer<uint32_t>(size_t(pairs_)), slots_ = Buffer<uint32_t>(size_t(pairs_)), masks_ = Buffer<uint16_t>(size_t(pairs_));
    const int64_t across = pieces_of(camera_.width, kTile), down = pieces_of(camera_.height, kTile);
    std::vector<int64_t> edges{0};  // bands of rows with about as many pairs each
    for (int64_t row = 1; row < down; row++)
        if (begin_[size_t(row * across)] * threads >= pairs_ * int64_t(edges.size()) && int64_t(edges.size()) < threads) edges.push_back(row);
    edges.push_back(down);
    parallel_for(threads, int64_t(edges.size()) - 1, [&](int, int64_t band) {
        const uint32_t first = uint32_t(edges[size_t(band)]), last = uint32_t(edges[size_t(band) + 1]) - 1;
        std::vector<uint32_t> cursor(begin_.get() + first * across, begin_.get() + (last + 1) * across);
        for (size_t k = 0; k < size_t(tiled_); k++) {
            if (k + 16 < size_t(tiled_)) __builtin_prefetch(&spans_[order[k + 16].id]);
            const uint32_t id = order[k].id;
            const Span& span = spans_[id];
            if (span.bottom < first || span.top > last) continue;
            uint32_t slot = span.begin;
            const auto enter = [&](uint32_t row, uint32_t from, uint32_t to) {
                if (row < first || row > last) {
                    slot += to - from + 1;
                    return;
                }
                uint32_t* next = cursor.data() + (row - first) * across;
                for (uint32_t column = from; column <= to; column++) {
                    const size_t entry = next[column]++;
                    ids_[entry] = id, slots_[entry] = slot++;
                }
            };
            if (span.is_box())
                for (uint32_t row = span.top; row <= span.bottom; row++) enter(row, span.left, span.right);
            else
                each_tile_row(records_[id], span, camera_.width, enter);
        }
    });
}

template <class R>
TileArgs<R> Frame<R>::tile_args(const R* background) const {
    return {camera_, settings_, background, records_.get(), begin_.get(), ids_.get(), masks_.get(), processed_.get(), items_.get(), light_.get(), last_.get(), nullptr, nullptr, nullptr};
}

template <class R>
int64_t Frame<R>::evaluated() const {
    return std::accumulate(items_.get(), items_.get() + tiles_, int64_t(0)) * kLanes;
}

template <class R>
void Frame<R>::gradient(const Inputs<R>& in, const R* v_color, const R* v_alpha, const R* v_depth, const Gradients<R>& out, int threads) const {
    if (in.count != count_) throw std::invalid_argument("the gradient needs the Gaussians of the forward pass");
    if (!light_.get()) throw std::invalid_argument("this frame was drawn without a gradient in mind");
    const Kernels<R>& run = kernels<R>();
    Stopwatch watch;
    Buffer<R> sums(size_t(pairs_) * kSums);
    Buffer<uint8_t> written{size_t(pairs_)};
    Buffer<double> v_background(out.background ? size_t(tiles_) * 3 : 0);
    const TileGradientArgs<R> tiles{tile_args(in.background), slots_.get(), v_color, v_alpha, v_depth, sums.get(), written.get(), out.background ? v_background.get() : nullptr};
    each_tile(threads, tiles_, [&](int, int64_t tile) { run.tile_gradient(tiles, tile); });
    if (out.background) {
        double ground[3] = {};
        for (int64_t tile = 0; tile < tiles_; tile++)
            for (int c = 0; c < 3; c++) ground[c] += v_background[size_t(3 * tile + c)];
        for (int c = 0; c < 3; c++) out.background[c] = R(ground[c]);
    }
    seconds_[kBlendGradient] = watch.lap();
    const GeometryGradientArgs<R> geometry{camera_, settings_, in, status_.get(), records_.get(), spans_.get(), sums.get(), written.get(),
                                           out.means, out.quats, out.log_scales, out.opacities, out.colors, out.offset};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        run.geometry_gradient(geometry, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
    seconds_[kGeometryGradient] = watch.lap();
}

template class Frame<float>;
template class Frame<double>;

}  // namespace graings
