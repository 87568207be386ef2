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

// A network of encoded directions and its buffers for one piece of anchors, per worker.
template <class R>
struct Head {
    Packed<R> packed;
    int degree, harmonics;
    const R* normals;
    int64_t outputs;
    Buffer<R> encoded, raw, scratch;

    Head(const Network<R>& network, int degree, const R* normals, int threads)
        : packed(network, nullptr, nullptr, false), degree(degree), harmonics(int(network.widths[0])), normals(normals), outputs(network.widths.back()),
          encoded(size_t(threads * kPieceAnchors * harmonics)), raw(size_t(threads * kPieceAnchors * outputs)), scratch(size_t(threads * packed.scratch)) {}

    // The outputs [anchors of the piece, outputs].
    const R* values(int worker, int64_t first, int64_t last, const R* directions, const int64_t* numbers) {
        NetworkArgs<R> args = packed.args;
        R* inputs = encoded.get() + worker * kPieceAnchors * harmonics;
        encode_directions(last - first, degree, directions, normals ? normals + 3 * first : nullptr, inputs, 1);
        args.input = inputs, args.output = raw.get() + worker * kPieceAnchors * outputs;
        args.shared += first * args.widths[1], args.groups = numbers;
        kernels<R>().network_values(args, 0, last - first, scratch.get() + worker * packed.scratch);
        return args.output;
    }
};

}  // namespace

template <class R>
void activate(Activation kind, int64_t count, const R* x, R* out, int threads) {
    in_pieces(threads, count, kPiece, [&](int, int64_t begin, int64_t end) { kernels<R>().activate(kind, end - begin, x + begin, out + begin); });
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
int64_t choose(const Shown<R>& in, const Rendered<R>& out, int threads) {
    const R bound = R(in.bound), threshold = R(in.threshold);
    const int64_t pieces = (in.count + kPiece - 1) / kPiece;
    Buffer<R> scores{size_t(in.count)};
    std::vector<int64_t> before(size_t(pieces) + 1, 0);
    in_pieces(threads, in.count, kPiece, [&](int, int64_t begin, int64_t end) {
        R *score = scores.get() + begin, changes[kPiece];
        for (int64_t r = begin; in.change && r < end; r++) changes[r - begin] = in.change[in.slots[r] * in.stride];
        if (in.change) kernels<R>().activate(kTanh, end - begin, changes, changes);
        int64_t above = 0;
        for (int64_t r = begin; r < end; r++, score++) {
            *score = in.opacities[in.slots[r]];
            if (in.change) *score += bound * changes[r - begin];
            above += *score > threshold;
        }
        before[size_t(begin / kPiece) + 1] = above;
    });
    std::partial_sum(before.begin(), before.end(), before.begin());
    in_pieces(threads, in.count, kPiece, [&](int, int64_t begin, int64_t end) {
        int64_t at = before[size_t(begin / kPiece)];
        for (int64_t r = begin; r < end; r++) {
            if (!(scores[size_t(r)] > threshold)) continue;
            out.rows[at] = r, out.slots[at] = in.slots[r], out.children[at] = in.children[r], out.uids[at] = in.uids[r];
            out.opacities[at++] = scores[size_t(r)];
        }
    });
    return before.back();
}

template <class R>
void move(const MoveArgs<R>& args, int64_t children, int64_t drawn, int threads) {
    for (int64_t i = 0; i < drawn; i++)
        if (args.rows[i] < 0 || args.rows[i] >= children) throw std::invalid_argument("rows must be children of this scene");
    in_pieces(threads, drawn, kPieceChildren, [&](int, int64_t begin, int64_t end) { kernels<R>().move_children(args, begin, end); });
}

template <class R>
void paint(const ColorNetworks<R>& in, const double* eye, double nearest, int64_t drawn, const int64_t* children, R* colors, int threads) {
    const int64_t slots = in.slots, row = 3 * slots;
    for (int64_t i = 0; i < drawn; i++)
        if (children[i] < (i ? children[i - 1] + 1 : 0) || children[i] >= in.anchors * slots)
            throw std::invalid_argument("children must be slots of these anchors in ascending order");
    Head<R> canonical(in.canonical, in.degree, in.normals, threads);
    std::optional<Head<R>> residual;
    if (in.residual_degree) residual.emplace(in.residual, in.residual_degree, nullptr, threads);
    Buffer<R> towards(size_t(threads * kPieceAnchors * 3)), changes(size_t(threads * kPieceAnchors * row));
    int64_t numbers[kPieceAnchors];
    for (int64_t i = 0; i < kPieceAnchors; i++) numbers[i] = i;
    in_pieces(threads, in.anchors, kPieceAnchors, [&](int worker, int64_t first, int64_t last) {
        const int64_t* from = std::lower_bound(children, children + drawn, first * slots);
        const int64_t* to = std::lower_bound(from, children + drawn, last * slots);
        if (from == to) return;
        R *direction = towards.get() + worker * kPieceAnchors * 3, *change = changes.get() + worker * kPieceAnchors * row;
        directions(last - first, in.position + 3 * first, eye, nearest, direction, 1);
        const R* raw = canonical.values(worker, first, last, direction, numbers);
        const R* seen = residual ? residual->values(worker, first, last, direction, numbers) : nullptr;
        R* out = colors + 3 * (from - children);
        for (const int64_t* child = from; child < to; child++) {
            const int64_t at = *child - first * slots, i = 3 * (child - from);
            std::copy_n(raw + 3 * at, 3, out + i);
            if (seen) std::copy_n(seen + 3 * at, 3, change + i);
            else if (in.time_only) std::copy_n(in.time_only + 4 * *child, 3, change + i);
        }
        kernels<R>().finish_colors(3 * (to - from), R(in.bound), seen || in.time_only ? change : nullptr, out);
    });
}

#define GRAINGS_INSTANTIATE(R)                                                                   \
    template void activate<R>(Activation, int64_t, const R*, R*, int);                           \
    template void directions<R>(int64_t, const R*, const double*, double, R*, int);              \
    template int64_t choose<R>(const Shown<R>&, const Rendered<R>&, int);                        \
    template void move<R>(const MoveArgs<R>&, int64_t, int64_t, int);                            \
    template void paint<R>(const ColorNetworks<R>&, const double*, double, int64_t, const int64_t*, R*, int);
GRAINGS_INSTANTIATE(float)
GRAINGS_INSTANTIATE(double)
#undef GRAINGS_INSTANTIATE

}  // namespace graings
