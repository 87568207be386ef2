#include "children.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "clip.hpp"
#include "pool.hpp"

namespace graings {
namespace {

constexpr int64_t kPiece = 2048;  // children per piece of work

template <class Body>
void in_pieces(int threads, int64_t count, Body body) {
    parallel_for(threads, (count + kPiece - 1) / kPiece, [&](int, int64_t piece) { body(piece * kPiece, std::min(count, (piece + 1) * kPiece)); });
}

// Calls body(first anchor, last, first child, last) for ranges of anchors and their drawn children.
template <class Body>
void in_runs(int threads, int64_t anchors, int64_t slots, int64_t drawn, const int64_t* children, Body body) {
    constexpr int64_t kRun = 512;
    parallel_for(threads, (anchors + kRun - 1) / kRun, [&](int, int64_t run) {
        const int64_t first = run * kRun, last = std::min(anchors, first + kRun);
        const int64_t* from = std::lower_bound(children, children + drawn, first * slots);
        const int64_t* to = std::lower_bound(from, children + drawn, last * slots);
        body(first, last, from - children, to - children);
    });
}

template <class R> struct Quat { R w, x, y, z; };

template <class R>
Quat<R> product(const Quat<R>& a, const Quat<R>& b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}
template <class R> Quat<R> conjugate(const Quat<R>& q) { return {q.w, -q.x, -q.y, -q.z}; }

// Smallest divisor of the normalisation, as in torch's normalize.
constexpr double kLeastNorm = 1e-12;

template <class R>
Quat<R> canonical(const R* raw, R& norm) {
    const Quat<R> q{raw[0] + R(1), raw[1], raw[2], raw[3]};
    norm = std::max(std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z), R(kLeastNorm));
    return {q.w / norm, q.x / norm, q.y / norm, q.z / norm};
}

template <class R> Quat<R> deformed_rotation(const R* deformation) { return {deformation[3] + R(1), deformation[4], deformation[5], deformation[6]}; }

}  // namespace

template <class R>
void gather(const Anchors<R>& anchors, int64_t drawn, const int64_t* children, R* row, R* centre, R* base, int threads) {
    const int64_t slots = anchors.slots, width = 3 + slots;
    for (int64_t i = 0; i < drawn; i++)
        if (children[i] < (i ? children[i - 1] + 1 : 0) || children[i] >= anchors.count * slots)
            throw std::invalid_argument("children must be slots of these anchors in ascending order");
    in_pieces(threads, drawn, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            const int64_t owner = children[i] / slots, slot = children[i] % slots;
            R* to = row + i * width;
            std::copy_n(anchors.offset + 3 * children[i], 3, to);
            std::fill_n(to + 3, slots, R(0));
            to[3 + slot] = R(1);
            for (int c = 0; c < 3; c++) {
                const R scale = anchors.log_scale[3 * owner + c];
                base[3 * i + c] = scale;
                centre[3 * i + c] = anchors.position[3 * owner + c] + std::exp(scale) * anchors.offset[3 * children[i] + c];
            }
        }
    });
}

template <class R>
void gather_gradient(const Anchors<R>& anchors, int64_t drawn, const int64_t* children, const R* v_row, const R* v_centre, const R* v_base, R* v_log_scale, R* v_offset,
                     int threads) {
    const int64_t slots = anchors.slots, width = 3 + slots;
    in_runs(threads, anchors.count, slots, drawn, children, [&](int64_t first, int64_t last, int64_t from, int64_t to) {
        std::fill(v_log_scale + 3 * first, v_log_scale + 3 * last, R(0));
        std::fill(v_offset + 3 * first * slots, v_offset + 3 * last * slots, R(0));
        for (int64_t i = from; i < to; i++) {
            const int64_t owner = children[i] / slots;
            const R* v = v_row + i * width;
            for (int c = 0; c < 3; c++) {
                const R stretch = std::exp(anchors.log_scale[3 * owner + c]), g = v_centre[3 * i + c] * stretch;
                v_offset[3 * children[i] + c] = v[c] + g;
                v_log_scale[3 * owner + c] += v_base[3 * i + c] + g * anchors.offset[3 * children[i] + c];
            }
        }
    });
}

template <class R>
void compose(const NetworkOutputs<R>& in, R* mean, R* quat, R* log_scale, R* shift, int threads) {
    const R extent = R(in.extent), change = R(in.bounds.change), low = R(in.bounds.low), high = R(in.bounds.high);
    in_pieces(threads, in.drawn, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            R norm;
            const Quat<R> still = canonical(in.canonical + 7 * i, norm);
            for (int64_t t = 0; t < in.times; t++) {
                const R* deformation = in.deformation ? in.deformation + 10 * (in.times * i + t) : nullptr;
                const int64_t to = t * in.drawn + i;
                const Quat<R> q = deformation ? product(still, deformed_rotation(deformation)) : still;
                quat[4 * to] = q.w, quat[4 * to + 1] = q.x, quat[4 * to + 2] = q.y, quat[4 * to + 3] = q.z;
                for (int c = 0; c < 3; c++) {
                    R scale = in.base[3 * i + c] + in.canonical[7 * i + 4 + c];
                    mean[3 * to + c] = in.centre[3 * i + c];
                    if (deformation) {
                        shift[3 * to + c] = deformation[c] * extent;
                        mean[3 * to + c] += shift[3 * to + c], scale += clip(deformation[7 + c], -change, change);
                    }
                    log_scale[3 * to + c] = clip(scale, low, high);
                }
            }
        }
    });
}

template <class R>
void compose_gradient(const NetworkOutputs<R>& in, const GeometryGradients<R>& v, R* v_canonical, R* v_base, R* v_centre, R* v_deformation, int threads) {
    const R extent = R(in.extent), change = R(in.bounds.change), low = R(in.bounds.low), high = R(in.bounds.high);
    in_pieces(threads, in.drawn, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++) {
            R norm;
            const Quat<R> q = canonical(in.canonical + 7 * i, norm);
            Quat<R> sum{R(0), R(0), R(0), R(0)};
            R scales[3] = {}, centre[3] = {};
            for (int64_t t = 0; t < in.times; t++) {
                const int64_t row = 10 * (in.times * i + t);
                const R* deformation = in.deformation ? in.deformation + row : nullptr;
                Quat<R> v_quat{R(0), R(0), R(0), R(0)};
                if (const R* from = v.quat[t]) v_quat = {from[4 * i], from[4 * i + 1], from[4 * i + 2], from[4 * i + 3]};
                if (deformation) {
                    // the adjoint of multiplication by a quaternion is multiplication by its conjugate
                    const Quat<R> turn = product(conjugate(q), v_quat);
                    R* to = v_deformation + row + 3;
                    to[0] = turn.w, to[1] = turn.x, to[2] = turn.y, to[3] = turn.z;
                    v_quat = product(v_quat, conjugate(deformed_rotation(deformation)));
                }
                sum = {sum.w + v_quat.w, sum.x + v_quat.x, sum.y + v_quat.y, sum.z + v_quat.z};
                for (int c = 0; c < 3; c++) {
                    R scale = in.base[3 * i + c] + in.canonical[7 * i + 4 + c];
                    if (deformation) scale += clip(deformation[7 + c], -change, change);
                    const R g = clip_gradient(v.log_scale[t] ? v.log_scale[t][3 * i + c] : R(0), scale, low, high, in.bounds.projected);
                    const R v_mean = v.mean[t] ? v.mean[t][3 * i + c] : R(0), v_shift = v.shift[t] ? v.shift[t][3 * i + c] : R(0);
                    scales[c] += g, centre[c] += v_mean;
                    if (!deformation) continue;
                    v_deformation[row + c] = (v_mean + v_shift) * extent;
                    v_deformation[row + 7 + c] = clip_gradient(g, deformation[7 + c], -change, change, in.bounds.projected);
                }
            }
            const R along = norm > R(kLeastNorm) ? sum.w * q.w + sum.x * q.x + sum.y * q.y + sum.z * q.z : R(0);
            R* to = v_canonical + 7 * i;
            to[0] = (sum.w - along * q.w) / norm, to[1] = (sum.x - along * q.x) / norm, to[2] = (sum.y - along * q.y) / norm, to[3] = (sum.z - along * q.z) / norm;
            std::copy_n(scales, 3, to + 4), std::copy_n(scales, 3, v_base + 3 * i), std::copy_n(centre, 3, v_centre + 3 * i);
        }
    });
}

#define GRAINGS_INSTANTIATE(R)                                                                                                           \
    template void gather<R>(const Anchors<R>&, int64_t, const int64_t*, R*, R*, R*, int);                                                \
    template void gather_gradient<R>(const Anchors<R>&, int64_t, const int64_t*, const R*, const R*, const R*, R*, R*, int);              \
    template void compose<R>(const NetworkOutputs<R>&, R*, R*, R*, R*, int);                                                                    \
    template void compose_gradient<R>(const NetworkOutputs<R>&, const GeometryGradients<R>&, R*, R*, R*, R*, int);
GRAINGS_INSTANTIATE(float)
GRAINGS_INSTANTIATE(double)
#undef GRAINGS_INSTANTIATE

}  // namespace graings
