#include "colors.hpp"

#include <algorithm>
#include <stdexcept>

#include "buffer.hpp"
#include "clip.hpp"
#include "isa.hpp"
#include "pool.hpp"

namespace graings {
namespace {

constexpr int64_t kPiece = 2048;  // children, or slots, per piece of work

template <class Body>
void in_pieces(int threads, int64_t count, Body body) {
    parallel_for(threads, (count + kPiece - 1) / kPiece, [&](int worker, int64_t piece) { body(worker, piece * kPiece, std::min(count, (piece + 1) * kPiece)); });
}

// Rows of `width` numbers of the children [begin, end), one after the other.
template <class R>
void gather_rows(const R* rows, int width, const int64_t* begin, const int64_t* end, R* to) {
    for (; begin < end; begin++, to += width) std::copy_n(rows + *begin * width, width, to);
}

}  // namespace

template <class R>
void child_colors(const ColorOutputs<R>& in, R* change, R* sum, R* drawn_color, int threads) {
    for (int64_t i = 0; i < in.drawn; i++)
        if (in.children[i] < (i ? in.children[i - 1] + 1 : 0) || in.children[i] >= in.slots)
            throw std::invalid_argument("children must be slots of these anchors in ascending order");
    const R bound = R(in.bound);
    in_pieces(threads, in.drawn, [&](int, int64_t begin, int64_t end) {
        gather_rows(in.color, 3, in.children + begin, in.children + end, sum + 3 * begin);
        kernels<R>().activate(kSigmoid, 3 * (end - begin), sum + 3 * begin, sum + 3 * begin);
        if (!in.residual) return;
        gather_rows(in.residual, 4, in.children + begin, in.children + end, change + 4 * begin);
        kernels<R>().activate(kTanh, 4 * (end - begin), change + 4 * begin, change + 4 * begin);
        for (int64_t i = 4 * begin; i < 4 * end; i++) change[i] *= bound;
        for (int64_t i = begin; i < end; i++)
            for (int c = 0; c < 3; c++) {
                sum[3 * i + c] += change[4 * i + c];
                drawn_color[3 * i + c] = clip(sum[3 * i + c], R(0), R(1));
            }
    });
}

template <class R>
void child_colors_gradient(const ColorOutputs<R>& in, const R* sum, const R* v_drawn_color, const R* v_change, R* v_color, R* v_residual, int threads) {
    const R bound = R(in.bound);
    Buffer<R> buffer(size_t(threads) * kPiece * 11);
    in_pieces(threads, in.slots, [&](int worker, int64_t first, int64_t last) {
        const int64_t* from = std::lower_bound(in.children, in.children + in.drawn, first);
        const int64_t* to = std::lower_bound(from, in.children + in.drawn, last);
        const int64_t begin = from - in.children, count = to - from;
        R *x = buffer.get() + worker * kPiece * 11, *v = x + 4 * kPiece, *v_sum = v + 4 * kPiece;
        for (int64_t i = 0; i < 3 * count; i++) {
            const R upstream = v_drawn_color ? v_drawn_color[3 * begin + i] : R(0);
            v_sum[i] = in.residual ? clip_gradient(upstream, sum[3 * begin + i], R(0), R(1), in.projected) : upstream;
        }
        std::fill(v_color + 3 * first, v_color + 3 * last, R(0));
        gather_rows(in.color, 3, from, to, x);
        kernels<R>().activate_gradient(kSigmoid, 3 * count, x, v_sum, v);
        for (int64_t i = 0; i < count; i++) std::copy_n(v + 3 * i, 3, v_color + 3 * from[i]);
        if (!in.residual) return;
        std::fill(v_residual + 4 * first, v_residual + 4 * last, R(0));
        for (int64_t i = 0; i < count; i++)
            for (int c = 0; c < 4; c++) v[4 * i + c] = bound * ((c < 3 ? v_sum[3 * i + c] : R(0)) + (v_change ? v_change[4 * (begin + i) + c] : R(0)));
        gather_rows(in.residual, 4, from, to, x);
        kernels<R>().activate_gradient(kTanh, 4 * count, x, v, v);
        for (int64_t i = 0; i < count; i++) std::copy_n(v + 4 * i, 4, v_residual + 4 * from[i]);
    });
}

#define GRAINGS_INSTANTIATE(R)                                              \
    template void child_colors<R>(const ColorOutputs<R>&, R*, R*, R*, int); \
    template void child_colors_gradient<R>(const ColorOutputs<R>&, const R*, const R*, const R*, R*, R*, int);
GRAINGS_INSTANTIATE(float)
GRAINGS_INSTANTIATE(double)
#undef GRAINGS_INSTANTIATE

}  // namespace graings
