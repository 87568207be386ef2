#include "prepared.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <vector>

#include "buffer.hpp"
#include "encoding.hpp"
#include "isa.hpp"
#include "packed.hpp"
#include "pool.hpp"

namespace graings {
namespace {

constexpr int64_t kPiece = 4096;        // numbers per piece of work
constexpr int64_t kPieceChildren = 1024;
constexpr int64_t kPieceAnchors = 4 * kNetworkRows;

template <class Body>
void in_pieces(int threads, int64_t count, int64_t size, Body body) {
    parallel_for(threads, (count + size - 1) / size, [&](int worker, int64_t piece) { body(worker, piece * size, std::min(count, (piece + 1) * size)); });
}

// Whether the frustum's camera may see a child.
template <class R>
bool may_see(const Wanted<R>& in, int64_t i) {
    if (!in.frustum) return true;
    const Frustum& f = *in.frustum;
    double away[3], at[3];
    for (int axis = 0; axis < 3; axis++) away[axis] = double(in.mean[3 * i + axis]) - f.center[axis];
    for (int axis = 0; axis < 3; axis++) at[axis] = f.rotation[3 * axis] * away[0] + f.rotation[3 * axis + 1] * away[1] + f.rotation[3 * axis + 2] * away[2];
    if (at[2] < f.near) return false;
    // In px times the depth; a centre within the image needs no bound of the footprint.
    const double x = f.fx * at[0] + f.cx * at[2], y = f.fy * at[1] + f.cy * at[2];
    const double outside = std::max({-x, x - f.width * at[2], -y, y - f.height * at[2]}) - f.constant * at[2];
    if (!(outside > 0)) return true;
    const R* scale = in.log_scale + 3 * i;
    return !(outside > f.spread * std::exp(double(std::max({scale[0], scale[1], scale[2]}))));
}

// A network with the inputs of a piece of anchors, each a group of its own, and buffers for each worker.
template <class R>
struct Head {
    Packed<R> packed;
    int64_t inputs, outputs;
    Buffer<R> encoded, raw, scratch;
    int64_t numbers[kPieceAnchors];

    Head(const Network<R>& network, int threads)
        : packed(network, nullptr, nullptr, false), inputs(network.widths[0]), outputs(network.widths.back()), encoded(size_t(threads * kPieceAnchors * inputs)),
          raw(size_t(threads * kPieceAnchors * outputs)), scratch(size_t(threads * packed.scratch)) {
        for (int64_t i = 0; i < kPieceAnchors; i++) numbers[i] = i;
    }

    // Outputs [count, outputs] of the anchors first + chosen[i] from `input`.
    void evaluate(int worker, int64_t first, int64_t count, const int64_t* chosen, const R* input, R* output) {
        NetworkArgs<R> args = packed.args;
        args.input = input, args.output = output;
        args.shared += first * args.widths[1], args.groups = chosen;
        kernels<R>().network_values(args, 0, count, scratch.get() + worker * packed.scratch);
    }

    // The same from the directions from `eye` to these anchors, in a buffer of the worker.
    const R* seen(int worker, int64_t first, int64_t count, const int64_t* chosen, const ColorNetworks<R>& in, const double* eye, double nearest, int degree, const R* normals) {
        R *input = encoded.get() + worker * kPieceAnchors * inputs, *output = raw.get() + worker * kPieceAnchors * outputs;
        R towards[3 * kPieceAnchors], normal[3 * kPieceAnchors];
        for (int64_t i = 0; i < count; i++) {
            std::copy_n(in.position + 3 * (first + chosen[i]), 3, towards + 3 * i);
            if (normals) std::copy_n(normals + 3 * (first + chosen[i]), 3, normal + 3 * i);
        }
        directions(count, towards, eye, nearest, towards, 1);
        encode_directions(count, degree, towards, normals ? normal : nullptr, input, 1);
        evaluate(worker, first, count, chosen, input, output);
        return output;
    }
};

}  // namespace

template <class R>
void activate(Activation kind, int64_t count, const R* x, R* out, int threads) {
    in_pieces(threads, count, kPiece, [&](int, int64_t begin, int64_t end) { kernels<R>().activate(kind, end - begin, x + begin, out + begin); });
}

template <class R>
void activate_gradient(Activation kind, int64_t count, const R* x, const R* v, R* out, int threads) {
    in_pieces(threads, count, kPiece, [&](int, int64_t begin, int64_t end) { kernels<R>().activate_gradient(kind, end - begin, x + begin, v + begin, out + begin); });
}

template <class R>
void directions(int64_t rows, const R* position, const double* eye, double nearest, R* out, int threads) {
    const R at[3] = {R(eye[0]), R(eye[1]), R(eye[2])};
    in_pieces(threads, rows, kPiece, [&](int, int64_t begin, int64_t end) {
        for (int64_t row = begin; row < end; row++) {
            const R *from = position + 3 * row, x = from[0] - at[0], y = from[1] - at[1], z = from[2] - at[2];
            const R distance = std::max(std::sqrt(x * x + y * y + z * z), R(nearest));
            out[3 * row] = x / distance, out[3 * row + 1] = y / distance, out[3 * row + 2] = z / distance;
        }
    });
}

template <class R>
int64_t choose(const Shown<R>& in, int64_t slots, const Rendered<R>& out, int threads) {
    const R bound = R(in.bound), threshold = R(in.threshold);
    int64_t stride = 0;
    if (in.change) {
        Head<R> head(in.residual, threads);
        stride = head.outputs * in.anchors / std::max<int64_t>(slots, 1);
        in_pieces(threads, in.anchors, kPieceAnchors, [&](int worker, int64_t first, int64_t last) { head.evaluate(worker, first, last - first, head.numbers, nullptr, in.change + first * head.outputs); });
    }
    const int64_t pieces = (in.count + kPiece - 1) / kPiece;
    Buffer<R> scores{size_t(in.count)};
    std::vector<int64_t> before(size_t(pieces) + 1, 0);
    in_pieces(threads, in.count, kPiece, [&](int, int64_t begin, int64_t end) {
        R *score = scores.get() + begin, changes[kPiece];
        for (int64_t r = begin; r < end; r++) {
            const int64_t slot = in.slots[r];
            if (slot < 0 || slot >= slots) throw std::invalid_argument("slots must have an opacity");
            score[r - begin] = in.opacities[slot];
            if (in.blended) score[r - begin] += in.blended[kBlended * r + 3];
            if (in.change) changes[r - begin] = in.change[slot * stride + stride - 1];
        }
        if (in.change) {
            kernels<R>().activate(kTanh, end - begin, changes, changes);
            for (int64_t i = 0; i < end - begin; i++) score[i] += bound * changes[i];
        }
        before[size_t(begin / kPiece) + 1] = std::count_if(score, score + (end - begin), [&](R x) { return x > threshold; });
    });
    std::partial_sum(before.begin(), before.end(), before.begin());
    in_pieces(threads, in.count, kPiece, [&](int, int64_t begin, int64_t end) {
        int64_t at = before[size_t(begin / kPiece)];
        for (int64_t r = begin; r < end; r++) {
            if (!(scores[size_t(r)] > threshold)) continue;
            out.rows[at] = r, out.slots[at] = in.slots[r], out.children[at] = in.children[r], out.uids[at] = in.uids[r];
            if (out.changes) std::copy_n(in.blended + kBlended * r, 3, out.changes + 3 * at);
            out.opacities[at++] = scores[size_t(r)];
        }
    });
    return before.back();
}

template <class R>
void blend(const BlendArgs<R>& args, int64_t blocks, int threads) {
    in_pieces(threads, blocks, kPiece / kMoving, [&](int, int64_t begin, int64_t end) { kernels<R>().blend_children(args, begin, end); });
}

template <class R>
void move(const MoveArgs<R>& args, int64_t children, int64_t drawn, int threads) {
    in_pieces(threads, drawn, kPieceChildren, [&](int, int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i++)
            if (args.rows[i] < 0 || args.rows[i] >= children) throw std::invalid_argument("rows must be children of this scene");
        kernels<R>().move_children(args, begin, end);
    });
}

template <class R>
void paint(const ColorNetworks<R>& in, const double* eye, double nearest, const Wanted<R>& wanted, R* colors, int threads) {
    const int64_t slots = in.slots, row = 3 * slots, drawn = wanted.drawn, *children = wanted.children;
    for (int64_t i = 0; i < drawn; i++)
        if (children[i] < (i ? children[i - 1] + 1 : 0) || children[i] >= in.anchors * slots)
            throw std::invalid_argument("children must be slots of these anchors in ascending order");
    Head<R> canonical(in.canonical, threads);
    std::optional<Head<R>> residual;
    if (in.residual_degree) residual.emplace(in.residual, threads);
    Buffer<R> buffer(size_t(threads * kPieceAnchors * 2 * row));
    in_pieces(threads, in.anchors, kPieceAnchors, [&](int worker, int64_t first, int64_t last) {
        const int64_t* from = std::lower_bound(children, children + drawn, first * slots);
        const int64_t* to = std::lower_bound(from, children + drawn, last * slots);
        // The anchors with a child that is wanted: the networks see only these.
        int64_t chosen[kPieceAnchors], count = 0;
        const int64_t *begins[kPieceAnchors], *ends[kPieceAnchors], *child = from;
        for (int64_t anchor = first; anchor < last; anchor++) {
            const int64_t *begin = child, past = (anchor + 1) * slots;
            bool any = false;
            for (; child < to && *child < past; child++) any = any || may_see(wanted, child - children);
            if (any) chosen[count] = anchor - first, begins[count] = begin, ends[count++] = child;
            else std::fill(colors + 3 * (begin - children), colors + 3 * (child - children), R(0));
        }
        if (!count) return;
        const R* raw = canonical.seen(worker, first, count, chosen, in, eye, nearest, in.degree, in.normals);
        const R* seen = residual ? residual->seen(worker, first, count, chosen, in, eye, nearest, in.residual_degree, nullptr) : nullptr;
        R *color = buffer.get() + worker * kPieceAnchors * 2 * row, *change = color + kPieceAnchors * row, *c = color, *d = change;
        for (int64_t i = 0; i < count; i++)
            for (const int64_t* each = begins[i]; each < ends[i]; each++, c += 3, d += 3) {
                const int64_t at = i * row + 3 * (*each - (first + chosen[i]) * slots);
                std::copy_n(raw + at, 3, c);
                if (in.blended) std::copy_n(in.blended + 3 * (each - children), 3, d);
                else if (seen) std::copy_n(seen + at, 3, d);
                else if (in.time_only) std::copy_n(in.time_only + 4 * *each, 3, d);
            }
        const int64_t numbers = c - color;
        if (in.blended) {
            kernels<R>().activate(kSigmoid, numbers, color, color);
            for (int64_t i = 0; i < numbers; i++) color[i] = std::min(std::max(color[i] + change[i], R(0)), R(1));
        } else
            kernels<R>().finish_colors(numbers, R(in.bound), seen || in.time_only ? change : nullptr, color);
        c = color;
        for (int64_t i = 0; i < count; i++) {
            const int64_t some = 3 * (ends[i] - begins[i]);
            std::copy_n(c, some, colors + 3 * (begins[i] - children)), c += some;
        }
    });
}

#define GRAINGS_INSTANTIATE(R)                                                                   \
    template void activate<R>(Activation, int64_t, const R*, R*, int);                           \
    template void activate_gradient<R>(Activation, int64_t, const R*, const R*, R*, int);        \
    template void directions<R>(int64_t, const R*, const double*, double, R*, int);              \
    template int64_t choose<R>(const Shown<R>&, int64_t, const Rendered<R>&, int);                        \
    template void blend<R>(const BlendArgs<R>&, int64_t, int);                                   \
    template void move<R>(const MoveArgs<R>&, int64_t, int64_t, int);                            \
    template void paint<R>(const ColorNetworks<R>&, const double*, double, const Wanted<R>&, R*, int);
GRAINGS_INSTANTIATE(float)
GRAINGS_INSTANTIATE(double)
#undef GRAINGS_INSTANTIATE

}  // namespace graings
