#include "frame.hpp"

#include <algorithm>
#include <bit>
#include <chrono>
#include <cstring>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>

#include "isa.hpp"

namespace graings {

namespace {

// Seconds between laps.
class Stopwatch {
public:
    double lap() {
        const auto now = std::chrono::steady_clock::now();
        return std::chrono::duration<double>(now - std::exchange(last_, now)).count();
    }

private:
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

constexpr int64_t kPiece = 512;  // Gaussians per piece of work

// Rank structure over `taken`: 0 or 1 for each of 64 * `words` slots.
Buffer<Ranks> ranked(const uint8_t* taken, int64_t words) {
    Buffer<Ranks> ranks{size_t(words)};
    uint32_t before = 0;
    for (int64_t word = 0; word < words; word++) {
        uint64_t bits = 0;
        for (int byte = 0; byte < 8; byte++) {
            uint64_t eight;  // one flag per byte; the product gathers them into one byte
            std::memcpy(&eight, taken + 64 * word + 8 * byte, sizeof eight);
            bits |= eight * 0x0102040810204080 >> 56 << 8 * byte;
        }
        ranks[size_t(word)] = {bits, before};
        before += uint32_t(std::popcount(bits));
    }
    return ranks;
}

}  // namespace

template <class R>
Frame<R>::Frame(const Camera& camera, const Settings& settings, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads, bool gradient)
    : camera_(camera), settings_(settings), count_(in.count),
      tiles_(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)), status_(size_t(in.count)),
      records_(size_t(in.count)) {
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::invalid_argument("more than 2^32 Gaussians");
    if (std::max(camera.width, camera.height) > kMaxImageSide) throw std::invalid_argument("an image may be at most " + std::to_string(kMaxImageSide) + " pixels wide and high");
    Stopwatch watch;
    const size_t depths_end = whole_lines(size_t(count_) * sizeof(double)), light_end = size_t(tiles_) * kBlocks * kLanes * sizeof(R);
    scratch_ = Buffer<std::byte>(std::max(depths_end + size_t(count_) * sizeof(Span), gradient ? 2 * light_end : 0));
    double* depths = reinterpret_cast<double*>(scratch_.get());
    Span* spans = reinterpret_cast<Span*>(scratch_.get() + depths_end);
    Binning<R> binning(camera_, settings_.compat, count_, records_.get(), spans, depths, uids, threads);
    const auto pieces = project({camera_, settings_, in, records_.get(), status_.get(), depths, spans, out.means2d, out.radii}, binning, threads);
    seconds_[kProject] = watch.lap();
    binning.enter(pieces);
    seconds_[kBin] = watch.lap();
    binning.sort();
    pairs_ = std::move(binning.pairs), begin_ = std::move(binning.begin), places_ = std::move(binning.places), pair_count_ = binning.count();
    seconds_[kSort] = watch.lap();

    const Kernels<R>& run = kernels<R>();
    kept_ = Buffer<int32_t>(size_t(tiles_)), items_ = Buffer<int32_t>(size_t(tiles_));
    if (gradient) light_ = reinterpret_cast<R*>(scratch_.get()), last_ = reinterpret_cast<R*>(scratch_.get() + light_end);
    else scratch_ = {};
    TileArgs<R> tiles = tile_args(in.background);
    tiles.color = out.color, tiles.alpha = out.alpha, tiles.depth = out.depth;
    const int64_t words = pair_count_ / 64 + 1;  // one more, because the rank of the end is needed too
    Buffer<uint8_t> shown(gradient ? size_t(64 * words) : 0);
    if (gradient) tiles.shown = shown.get(), std::fill_n(shown.get(), 64 * words, uint8_t(0));
    Buffer<TileEntry<R>> chunks(size_t(threads) * kChunk);
    each_tile(threads, tiles_, [&](int worker, int64_t tile, int64_t end) { run.draw_tile(tiles, tile, end, chunks.get() + worker * kChunk); });
    if (gradient) {
        ranks_ = ranked(shown.get(), words);
        const Ranks& end = ranks_[size_t(words - 1)];
        shown_ = end.before + std::popcount(end.taken);
    }
    seconds_[kBlend] = watch.lap();
}

// Computes records and spans, and counts their pairs.
template <class R>
std::vector<Piece> Frame<R>::project(const ProjectArgs<R>& args, Binning<R>& binning, int threads) {
    std::vector<Piece> pieces{size_t(pieces_of(count_, kPiece))};
    parallel_for(threads, int64_t(pieces.size()), [&](int worker, int64_t index) {
        Piece& piece = pieces[size_t(index)];
        piece.begin = index * kPiece, piece.end = std::min(count_, (index + 1) * kPiece), piece.worker = worker;
        kernels<R>().project(args, piece.begin, piece.end);
        for (int64_t k = 0, left = piece.end - piece.begin; k < kStatuses && left > 0; k++)  // usually all are drawn, and the loop ends at once
            left -= piece.statuses[size_t(k)] = std::count(status_.get() + piece.begin, status_.get() + piece.end, k);
        binning.count(piece);
    });
    for (const Piece& piece : pieces)
        for (int k = 0; k < kStatuses; k++) statuses_[k] += piece.statuses[size_t(k)];
    return pieces;
}

template <class R>
TileArgs<R> Frame<R>::tile_args(const R* background) const {
    return {camera_, settings_, background, records_.get(), begin_.get(), pairs_.get(), kept_.get(), items_.get(), nullptr, light_, last_, nullptr, nullptr, nullptr};
}

template <class R>
int64_t Frame<R>::evaluated() const {
    return std::accumulate(items_.get(), items_.get() + tiles_, int64_t(0)) * kLanes;
}

template <class R>
void Frame<R>::pixels_gradient(const R* background, const R* v_color, const R* v_alpha, const R* v_depth, R* v_background, int threads) {
    if (!light_) throw std::logic_error("this frame keeps no state for a backward pass: it was drawn without one, or has been differentiated already");
    Stopwatch watch;
    sums_ = Buffer<R>(size_t(shown_) * kSumStride);
    Buffer<double> tile_backgrounds(v_background ? size_t(tiles_) * 3 : 0);
    const TileGradientArgs<R> tiles{tile_args(background), v_color, v_alpha, v_depth, ranks_.get(), sums_.get(), v_background ? tile_backgrounds.get() : nullptr};
    each_tile(threads, tiles_, [&](int, int64_t tile, int64_t) { kernels<R>().tile_gradient(tiles, tile); });
    if (v_background) {
        double background_sum[3] = {};
        for (int64_t tile = 0; tile < tiles_; tile++)
            for (int c = 0; c < 3; c++) background_sum[c] += tile_backgrounds[size_t(3 * tile + c)];
        for (int c = 0; c < 3; c++) v_background[c] = R(background_sum[c]);
    }
    records_ = {}, pairs_ = {}, scratch_ = {}, light_ = last_ = nullptr;
    seconds_[kBlendGradient] = watch.lap();
}

template <class R>
void Frame<R>::gaussians_gradient(const Inputs<R>& in, const Gradients<R>& out, int threads) {
    if (in.count != count_) throw std::invalid_argument("gaussians_gradient needs the Gaussians of the forward pass");
    if (!sums_.get()) throw std::logic_error("gaussians_gradient must follow pixels_gradient");
    Stopwatch watch;
    const GeometryGradientArgs<R> geometry{camera_, settings_, in, status_.get(), places_.get(), ranks_.get(), sums_.get(),
                                           out.means, out.quats, out.log_scales, out.opacities, out.colors, out.offset};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        kernels<R>().geometry_gradient(geometry, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
    sums_ = {}, places_ = {}, ranks_ = {}, status_ = {};
    seconds_[kGeometryGradient] = watch.lap();
}

template class Frame<float>;
template class Frame<double>;

}  // namespace graings
