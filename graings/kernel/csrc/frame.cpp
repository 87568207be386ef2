#include "frame.hpp"

#include <algorithm>
#include <chrono>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <string>
#include <utility>

#include "isa.hpp"

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

}  // namespace

template <class R>
Frame<R>::Frame(const Camera& camera, const Settings& settings, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads, bool gradient)
    : camera_(camera), settings_(settings), count_(in.count),
      tiles_(pieces_of(camera.width, kTile) * pieces_of(camera.height, kTile)), status_(size_t(in.count)),
      records_(size_t(in.count)), spans_(size_t(in.count)) {
    if (count_ > int64_t(std::numeric_limits<uint32_t>::max())) throw std::invalid_argument("more than 2^32 Gaussians");
    if (std::max(camera.width, camera.height) > kLongestSide) throw std::invalid_argument("an image may be at most " + std::to_string(kLongestSide) + " pixels wide and high");
    Stopwatch watch;
    Buffer<double> depths{size_t(count_)};
    Binning<R> binning(camera_, settings_.compat, records_.get(), spans_.get(), depths.get(), uids, threads);
    const auto pieces = project({camera_, settings_, in, records_.get(), status_.get(), depths.get(), spans_.get(), out.means2d, out.radii}, binning, threads);
    seconds_[kProject] = watch.lap();
    binning.enter(pieces);
    seconds_[kBin] = watch.lap();
    binning.sort();
    pairs_ = std::move(binning.pairs), begin_ = std::move(binning.begin), pair_count_ = binning.count();
    seconds_[kSort] = watch.lap();

    const Kernels<R>& run = kernels<R>();
    processed_ = Buffer<int32_t>(size_t(tiles_)), items_ = Buffer<int32_t>(size_t(tiles_));
    if (gradient) light_ = Buffer<R>(size_t(tiles_) * kBlocks * kLanes), last_ = Buffer<R>(size_t(tiles_) * kBlocks * kLanes);
    TileArgs<R> tiles = tile_args(in.background);
    tiles.color = out.color, tiles.alpha = out.alpha, tiles.depth = out.depth;
    Buffer<TileEntry<R>> chunks(size_t(threads) * kChunk);
    each_tile(threads, tiles_, [&](int worker, int64_t tile) { run.draw_tile(tiles, tile, chunks.get() + worker * kChunk); });
    seconds_[kBlend] = watch.lap();
}

// Records and spans, and how many pairs they will have.
template <class R>
std::vector<Piece> Frame<R>::project(const ProjectArgs<R>& args, Binning<R>& binning, int threads) {
    std::vector<Piece> pieces{size_t(pieces_of(count_, kPiece))};
    parallel_for(threads, int64_t(pieces.size()), [&](int worker, int64_t index) {
        Piece& piece = pieces[size_t(index)];
        piece.begin = index * kPiece, piece.end = std::min(count_, (index + 1) * kPiece), piece.worker = worker;
        kernels<R>().project(args, piece.begin, piece.end);
        for (int64_t k = 0, left = piece.end - piece.begin; k < kStatuses && left > 0; k++)  // most pieces are drawn whole
            left -= piece.statuses[size_t(k)] = std::count(status_.get() + piece.begin, status_.get() + piece.end, k);
        binning.count(piece);
    });
    for (const Piece& piece : pieces)
        for (int k = 0; k < kStatuses; k++) statuses_[k] += piece.statuses[size_t(k)];
    return pieces;
}

template <class R>
TileArgs<R> Frame<R>::tile_args(const R* background) const {
    return {camera_, settings_, background, records_.get(), begin_.get(), pairs_.get(), processed_.get(), items_.get(), light_.get(), last_.get(), nullptr, nullptr, nullptr};
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
    Buffer<R> sums(size_t(pair_count_) * kSumStride);
    Buffer<uint8_t> written{size_t(pair_count_)};
    Buffer<double> v_background(out.background ? size_t(tiles_) * 3 : 0);
    const TileGradientArgs<R> tiles{tile_args(in.background), v_color, v_alpha, v_depth, sums.get(), written.get(), out.background ? v_background.get() : nullptr};
    each_tile(threads, tiles_, [&](int, int64_t tile) { run.tile_gradient(tiles, tile); });
    if (out.background) {
        double ground[3] = {};
        for (int64_t tile = 0; tile < tiles_; tile++)
            for (int c = 0; c < 3; c++) ground[c] += v_background[size_t(3 * tile + c)];
        for (int c = 0; c < 3; c++) out.background[c] = R(ground[c]);
    }
    seconds_[kBlendGradient] = watch.lap();
    const GeometryGradientArgs<R> geometry{camera_, settings_, in, status_.get(), spans_.get(), sums.get(), written.get(),
                                           out.means, out.quats, out.log_scales, out.opacities, out.colors, out.offset};
    parallel_for(threads, pieces_of(count_, kPiece), [&](int, int64_t piece) {
        run.geometry_gradient(geometry, piece * kPiece, std::min(count_, (piece + 1) * kPiece));
    });
    seconds_[kGeometryGradient] = watch.lap();
}

template class Frame<float>;
template class Frame<double>;

}  // namespace graings
