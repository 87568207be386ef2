// One drawn view: runs the stages of the forward pass and keeps the state that the backward pass needs.
#pragma once
#include <vector>
#include "binning.hpp"
#include "buffer.hpp"
#include "types.hpp"

namespace graings {

template <class R>
struct Outputs {
    R *color, *alpha, *depth, *means2d, *radii;  // depth may be null
};

template <class R>
struct Gradients {
    R *means, *quats, *log_scales, *opacities, *colors, *offset;  // the last one may be null
};

enum Stage { kProject, kBin, kSort, kBlend, kBlendGradient, kGeometryGradient, kStages };

template <class R>
class Frame {
public:
    // `uids` break ties of depth. Keeps no pointer into `in` or `out`; keeps state for the backward pass if `gradient`.
    Frame(const Camera&, const Settings&, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads, bool gradient);

    // The backward pass has two halves, called once each and in this order; both free the state they have used.
    // First the gradient of the pixels: partial sums per pair, and the background's gradient. v_alpha, v_depth and
    // v_background may be null.
    void pixels_gradient(const R* background, const R* v_color, const R* v_alpha, const R* v_depth, R* v_background, int threads);

    // Then the gradient of the Gaussians. `in` must hold the same values as in the forward pass.
    void gaussians_gradient(const Inputs<R>& in, const Gradients<R>& out, int threads);

    const int64_t* statuses() const { return statuses_; }
    int64_t pairs() const { return pair_count_; }
    int64_t evaluated() const;  // (pixel, Gaussian) pairs
    const double* seconds() const { return seconds_; }  // per Stage

private:
    std::vector<Piece> project(const ProjectArgs<R>&, Binning<R>&, int threads);
    TileArgs<R> tile_args(const R* background) const;

    Camera camera_;
    Settings settings_;
    int64_t count_, tiles_, pair_count_ = 0;
    int64_t statuses_[kStatuses] = {};
    double seconds_[kStages] = {};
    Buffer<uint8_t> status_;
    Buffer<Record<R>> records_;
    Buffer<uint32_t> places_;
    Buffer<int64_t> begin_;
    Buffer<Pair> pairs_;
    Buffer<int32_t> kept_, items_;
    Buffer<Ranks> ranks_;
    int64_t shown_ = 0;  // pairs that some block has drawn
    Buffer<std::byte> scratch_;  // depths and spans during binning, then per-pixel state
    R *light_ = nullptr, *last_ = nullptr;
    Buffer<R> sums_;
};

}  // namespace graings
