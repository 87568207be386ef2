#include "frame.hpp"

#include <algorithm>
#include <bit>
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

constexpr int64_t kPiece = 512;  // Gaussians handed to a thread at a time

int64_t pieces_of(int64_t count, int64_t piece) { return (count + piece - 1) / piece; }

// Tiles that a record may touch, row by row: visit(first tile, last tile).
template <class R, class Visit>
void each_tile_row(const Record<R>& record, const Camera& camera, bool compat, const R* radii, Visit visit) {
    const int64_t across = pieces_of(camera.width, kTile), down = pieces_of(camera.height, kTile);
    if (compat) {
        const auto bound = [](double value, int64_t high) { return int64_t(std::clamp(value, 0.0, double(high))); };
        const int64_t x0 = bound(std::floor((record.x - double(radii[0])) / kTile), across), x1 = bound(std::ceil((record.x + double(radii[0])) / kTile), across);
        const int64_t y0 = bound(std::floor((record.y - double(radii[1])) / kTile), down), y1 = bound(std::ceil((record.y + double(radii[1])) / kTile), down);
        for (int64_t row = y0; row < y1; row++)
            if (x0 < x1) visit(row * across + x0, row * across + x1 - 1);
        return;
    }
    const double level = double(record.level), steep = record.slope * record.sr;
    const double highest = std::sqrt(level) / record.sy;
    const double turn = highest * steep / std::sqrt(steep * steep + record.sy * record.sy);
    const double first = std::max(std::ceil(record.y - highest - 0.5), 0.0), last = std::min(std::floor(record.y + highest - 0.5), double(camera.height - 1));
    if (!(first <= last)) return;
    for (int64_t row = int64_t(first) / kTile; row <= int64_t(last) / kTile; row++) {
        const double low = std::max(double(row * kTile) + 0.5 - record.y, -highest);
        const double high = std::min(double(row * kTile + kTile) - 0.5 - record.y, highest);
        if (low > high) continue;
        const auto edge = [&](double side) {
            const double dy = std::clamp(side * turn, low, high), s = dy * record.sy;
            return record.x + record.slope * dy + side * std::sqrt(std::max(level - s * s, 0.0)) / record.sr;
        };
        const double from = std::max(std::ceil(edge(-1) - 0.5), 0.0), to = std::min(std::floor(edge(1) - 0.5), double(camera.width - 1));
        if (from <= to) visit(row * across + int64_t(from) / kTile, row * across + int64_t(to) / kTile);
    }
}

}  // namespace

template <class R>
Frame<R>::Frame(const Camera& camera, const Settings& settings, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads)
    : camera_(camera), settings_(settings), count_(in.count),
      tiles_(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)), status_(size_t(in.count)),
      records_(size_t(in.count)), pair_begin_(size_t(in.count)), pair_count_(size_t(in.count)) {
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::invalid_argument("more than 2^32 Gaussians");
    const Kernels<R>& run = kernels<R>();
    Buffer<double> depths{size_t(count_)};
    const ProjectArgs<R> project{camera_, settings_, in, records_.get(), status_.get(), depths.get(), out.means2d, out.radii};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        run.project(project, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
    const auto order = sorted(depths.get(), uids);
    bin(order, out.radii, threads);

    processed_ = Buffer<int32_t>(size_t(tiles_)), items_ = Buffer<int32_t>(size_t(tiles_));
    TileArgs<R> tiles = tile_args(in.background);
    tiles.color = out.color, tiles.alpha = out.alpha, tiles.depth = out.depth;
    Buffer<TileEntry<R>> chunks(size_t(threads) * kChunk);
    parallel_for(threads, tiles_, [&](int worker, int64_t tile) { run.draw_tile(tiles, tile, chunks.get() + worker * kChunk); });
}

// Visible Gaussians by (depth, uid): a radix sort on the leading 32 bits of the depth range, then the few runs
// that agree in them by comparison.
template <class R>
std::vector<uint32_t> Frame<R>::sorted(const double* depths, const int64_t* uids) {
    struct Key { uint32_t key, id; };
    uint64_t least = ~uint64_t(0), most = 0;
    size_t visible = 0;
    for (int64_t i = 0; i < count_; i++) {
        statuses_[status_[size_t(i)]]++;
        if (status_[size_t(i)] != kDrawn) continue;
        const uint64_t bits = std::bit_cast<uint64_t>(depths[i]);  // positive: ordered like the numbers
        least = std::min(least, bits), most = std::max(most, bits), visible++;
    }
    std::vector<Key> keys(visible), spare(visible);
    const int shift = visible ? std::max(0, int(std::bit_width(most - least)) - 32) : 0;
    size_t n = 0;
    for (int64_t i = 0; i < count_; i++)
        if (status_[size_t(i)] == kDrawn) keys[n++] = {uint32_t((std::bit_cast<uint64_t>(depths[i]) - least) >> shift), uint32_t(i)};
    for (int pass = 0; pass < 3; pass++) {
        std::vector<size_t> at(2048, 0);
        const auto digit = [&](const Key& k) { return (k.key >> (11 * pass)) & 2047; };
        for (const Key& k : keys) at[digit(k)]++;
        size_t total = 0;
        for (size_t& start : at) start = std::exchange(total, total + start);
        for (const Key& k : keys) spare[at[digit(k)]++] = k;
        keys.swap(spare);
    }
    const auto before = [&](const Key& a, const Key& b) {
        return std::tuple(depths[a.id], uids[a.id], a.id) < std::tuple(depths[b.id], uids[b.id], b.id);
    };
    for (size_t i = 0; i < visible;) {
        size_t j = i + 1;
        while (j < visible && keys[j].key == keys[i].key) j++;
        if (j > i + 1) std::sort(keys.begin() + std::ptrdiff_t(i), keys.begin() + std::ptrdiff_t(j), before);
        i = j;
    }
    std::vector<uint32_t> order(visible);
    std::transform(keys.begin(), keys.end(), order.begin(), [](const Key& k) { return k.id; });
    return order;
}

// A stable counting pass: contiguous runs of the depth order are binned independently, then laid one behind another.
template <class R>
void Frame<R>::bin(const std::vector<uint32_t>& order, const R* radii, int threads) {
    const int64_t visible = int64_t(order.size());
    const int64_t runs = std::max<int64_t>(1, std::min<int64_t>(threads, visible));
    std::vector<std::vector<uint32_t>> touched{size_t(runs)};
    std::vector<std::vector<int64_t>> cursors{size_t(runs)};
    const auto first = [&](int64_t run) { return visible * run / runs; };
    parallel_for(threads, runs, [&](int, int64_t run) {
        auto& tiles = touched[size_t(run)];
        auto& counts = cursors[size_t(run)];
        counts.assign(size_t(tiles_), 0);
        tiles.reserve(size_t(3 * (first(run + 1) - first(run))));
        for (int64_t k = first(run); k < first(run + 1); k++) {
            if (k + 16 < first(run + 1)) __builtin_prefetch(&records_[order[size_t(k + 16)]]);
            const uint32_t id = order[size_t(k)];
            pair_begin_[id] = int64_t(tiles.size());
            each_tile_row(records_[id], camera_, settings_.compat, radii + 2 * size_t(id), [&](int64_t from, int64_t to) {
                for (int64_t tile = from; tile <= to; tile++) tiles.push_back(uint32_t(tile)), counts[size_t(tile)]++;
            });
            pair_count_[id] = int64_t(tiles.size()) - pair_begin_[id];
        }
    });
    begin_ = Buffer<int64_t>(size_t(tiles_) + 1);
    for (int64_t tile = 0; tile < tiles_; tile++) {
        begin_[size_t(tile)] = pairs_;
        for (auto& counts : cursors) counts[size_t(tile)] = std::exchange(pairs_, pairs_ + counts[size_t(tile)]);
    }
    begin_[size_t(tiles_)] = pairs_;
    ids_ = Buffer<uint32_t>(size_t(pairs_)), slots_ = Buffer<int64_t>(size_t(pairs_)), masks_ = Buffer<uint16_t>(size_t(pairs_));
    std::vector<int64_t> base(size_t(runs), 0);
    for (int64_t run = 1; run < runs; run++) base[size_t(run)] = base[size_t(run - 1)] + int64_t(touched[size_t(run - 1)].size());
    parallel_for(threads, runs, [&](int, int64_t run) {
        const auto& tiles = touched[size_t(run)];
        auto& counts = cursors[size_t(run)];
        for (int64_t k = first(run); k < first(run + 1); k++) {
            const uint32_t id = order[size_t(k)];
            for (int64_t pair = pair_begin_[id], end = pair + pair_count_[id]; pair < end; pair++) {
                const int64_t entry = counts[tiles[size_t(pair)]]++;
                ids_[size_t(entry)] = id, slots_[size_t(entry)] = base[size_t(run)] + pair;
            }
            pair_begin_[id] += base[size_t(run)];
        }
    });
}

template <class R>
TileArgs<R> Frame<R>::tile_args(const R* background) const {
    return {camera_, settings_, background, records_.get(), begin_.get(), ids_.get(), masks_.get(), processed_.get(), items_.get(), nullptr, nullptr, nullptr};
}

template <class R>
void Frame<R>::gradient(const Inputs<R>& in, const R* v_color, const R* v_alpha, const R* v_depth, const Gradients<R>& out, int threads) const {
    if (in.count != count_) throw std::invalid_argument("the gradient needs the Gaussians of the forward pass");
    const Kernels<R>& run = kernels<R>();
    int64_t entries = 0, items = 0;
    for (int64_t tile = 0; tile < tiles_; tile++)
        entries = std::max<int64_t>(entries, processed_[size_t(tile)]), items = std::max<int64_t>(items, items_[size_t(tile)]);
    struct Scratch {
        Buffer<TileEntry<R>> entries;
        Buffer<int32_t> first_item;
        Buffer<R> alphas, weights;
    };
    std::vector<Scratch> scratch{size_t(threads)};
    Buffer<R> sums(size_t(pairs_) * kSums);
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
    const GeometryGradientArgs<R> geometry{camera_, settings_, in, status_.get(), records_.get(), pair_begin_.get(), pair_count_.get(), sums.get(),
                                           out.means, out.quats, out.log_scales, out.opacities, out.colors, out.offset};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        run.geometry_gradient(geometry, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
}

template <class R>
Likeness compare(int64_t height, int64_t width, const R* image, const R* target, Likeness weights, R* gradient, int threads) {
    constexpr int64_t kBand = 16;  // rows
    const Kernels<R>& run = kernels<R>();
    const int64_t bands = pieces_of(height, kBand), row = 3 * width + 2 * 15 + 2 * kLanes;
    const double scale = 1.0 / (3.0 * double(height) * double(width));
    Buffer<double> sums{size_t(2 * bands)};
    Buffer<R> maps(gradient ? size_t(9 * height * width) : 1), scratch(size_t(threads) * size_t(5 * row));
    const SsimArgs<R> args{height, width, image, target, gradient, gradient ? maps.get() : nullptr, sums.get(), R(weights.similarity * scale), R(weights.absolute * scale)};
    const auto end = [&](int64_t band) { return std::min(height, (band + 1) * kBand); };
    parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_values(args, band, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    if (gradient)
        parallel_for(threads, bands, [&](int worker, int64_t band) { run.ssim_gradient(args, band * kBand, end(band), scratch.get() + worker * 5 * row); });
    Likeness mean{};
    for (int64_t band = 0; band < bands; band++) mean.similarity += sums[size_t(2 * band)] * scale, mean.absolute += sums[size_t(2 * band + 1)] * scale;
    return mean;
}

template class Frame<float>;
template class Frame<double>;
template Likeness compare<float>(int64_t, int64_t, const float*, const float*, Likeness, float*, int);
template Likeness compare<double>(int64_t, int64_t, const double*, const double*, Likeness, double*, int);

}  // namespace graings
