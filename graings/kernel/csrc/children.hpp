// The drawn children of anchors: gathers the inputs of the networks and composes Gaussians from their outputs.
// A child is the index anchor * slots + slot; children ascend, so that those of an anchor are contiguous.
#pragma once
#include <cstdint>
#include <vector>

namespace graings {

template <class R>
struct Anchors {
    int64_t count, slots;
    const R *position, *log_scale, *offset;  // [count, 3], [count, 3], [count * slots, 3]
};

// row [drawn, 3 + slots]: offset, and the one-hot slot of the child; centre [drawn, 3] = place + exp(log_scale) * offset
// (Eq. 4); base [drawn, 3] = log_scale. Throws std::invalid_argument when children do not ascend.
template <class R>
void gather(const Anchors<R>&, int64_t drawn, const int64_t* children, R* row, R* centre, R* base, int threads);

// The adjoint; writes the gradients of all anchors, zero for those without a drawn child.
template <class R>
void gather_gradient(const Anchors<R>&, int64_t drawn, const int64_t* children, const R* v_row, const R* v_centre, const R* v_base, R* v_log_scale, R* v_offset,
                     int threads);

// Bounds of log-scales: |change over time| <= change, and low <= result <= high.
struct ScaleBounds {
    double change, low, high;
    bool projected;  // clipped values receive gradients that move them back inside
};

template <class R>
struct NetworkOutputs {
    int64_t drawn, times;                // one time without a deformation
    const R *canonical, *base, *centre;  // [drawn, 7]: quaternion less the identity, log-scale less base; [drawn, 3] each
    const R* deformation;                // [drawn, times, 10]: position in units of `extent`, rotation, log-scale; or null
    double extent;
    ScaleBounds bounds;
};

// For each time, shift [times, drawn, 3] = extent * position, null without a deformation; mean [times, drawn, 3] = centre + shift;
// quat [times, drawn, 4] = unit(1 + canonical) times 1 + rotation; log_scale [times, drawn, 3] = base + canonical + change,
// both bounded (Eq. 5 and 10).
template <class R>
void compose(const NetworkOutputs<R>&, R* mean, R* quat, R* log_scale, R* shift, int threads);

// Gradients of what `compose` writes, an array for each time; null is zero.
template <class R>
struct GeometryGradients {
    std::vector<const R*> mean, quat, log_scale, shift;
};

// The adjoint; v_deformation is null if deformation is.
template <class R>
void compose_gradient(const NetworkOutputs<R>&, const GeometryGradients<R>&, R* v_canonical, R* v_base, R* v_centre, R* v_deformation, int threads);

}  // namespace graings
