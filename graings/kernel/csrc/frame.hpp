// One drawn view: runs the stages of the forward pass and keeps what the gradient needs.
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
    R *means, *quats, *log_scales, *opacities, *colors, *background, *offset;  // the last two may be null
};

enum Stage { kProject, kBin, kSort, kBlend, kBlendGradient, kGeometryGradient, kStages };

template <class R>
class Frame {
public:
    // `uids` break ties of depth. Keeps no pointer into `in` or `out`, and what a gradient needs only if there will be one.
    Frame(const Camera&, const Settings&, const Inputs<R>& in, const int64_t* uids, const Outputs<R>& out, int threads, bool gradient);

    // `in` must hold the same values as in the forward pass. v_alpha, v_depth may be null.
    void gradient(const Inputs<R>& in, const R* v_color, const R* v_alpha, const R* v_depth, const Gradients<R>& out, int threads) const;

    const int64_t* statuses() const { return statuses_; }
    int64_t pairs() const { return pair_count_; }
    int64_t evaluated() const;  // pairs of pixel and Gaussian
    const double* seconds() const { return seconds_; }  // per Stage

private:
    std::vector<Piece> project(const ProjectArgs<R>&, Binning<R>&, int threads);
    TileArgs<R> tile_args(const R* background) const;

    Camera camera_;
    Settings settings_;
    int64_t count_, tiles_, pair_count_ = 0;
    int64_t statuses_[kStatuses] = {};
    mutable double seconds_[kStages] = {};
    Buffer<uint8_t> status_;
    Buffer<Record<R>> records_;
    Buffer<Span> spans_;
    Buffer<int64_t> begin_;
    Buffer<Pair> pairs_;
    Buffer<int32_t> processed_, items_;
    Buffer<R> light_, last_;
};

}  // namespace graings
