// The drawn children of anchors: what the networks read of them, and what becomes of the networks' answers.
// Children are flat slots (anchor * slots + child) in ascending order, so that all sums over an anchor are runs.
#pragma once
#include <cstdint>

namespace graings {

template <class R>
struct Anchors {
    int64_t count, slots;
    const R *position, *log_scale, *offset;  // [count, 3], [count, 3], [count * slots, 3]
};

// row [drawn, 3 + slots]: offset, and a one at the child's slot; centre [drawn, 3] = place + exp(log_scale) * offset
// (Eq. 4); base [drawn, 3] = log_scale. Throws std::invalid_argument when children do not ascend.
template <class R>
void gather(const Anchors<R>&, int64_t drawn, const int64_t* children, R* row, R* centre, R* base, int threads);

// The adjoint; all gradients of the anchors are written, zero where nothing is drawn.
template <class R>
void gather_gradient(const Anchors<R>&, int64_t drawn, const int64_t* children, const R* v_row, const R* v_centre, const R* v_base, R* v_log_scale, R* v_offset,
                     int threads);

// Bounds of log-scales: of their change in time, and of the result.
struct ScaleBounds {
    double change, low, high;
    bool projected;  // let a value outside receive the gradients that point back inside
};

template <class R>
struct NetworkOutputs {
    int64_t drawn;
    const R *canonical, *base, *centre;  // [drawn, 7]: quaternion less the identity, log-scale less base; [drawn, 3] each
    const R* deformation;                      // [drawn, 10]: position in units of `extent`, rotation, log-scale; or null
    double extent;
    ScaleBounds bounds;
};

// mean [drawn, 3] = centre + extent * position; quat [drawn, 4] = unit(1 + canonical) times 1 + rotation;
// log_scale [drawn, 3] = base + canonical + change, both bounded (Eq. 5 and 10).
template <class R>
void compose(const NetworkOutputs<R>&, R* mean, R* quat, R* log_scale, int threads);

// The adjoint; v_moved is null where there is no `moved`. The gradient of base is that of log_scale's canonical part,
// that of centre is v_mean itself.
template <class R>
void compose_gradient(const NetworkOutputs<R>&, const R* v_mean, const R* v_quat, const R* v_log_scale, R* v_canonical, R* v_deformation, int threads);

}  // namespace graings
