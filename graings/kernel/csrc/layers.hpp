// Linear layers with ReLU between them, a block of rows at a time, so that the output of a layer is still in cache when
// the next layer reads it.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

#if defined(__AVX512F__) || defined(__aarch64__)
constexpr int kStripRows = 8;  // 8 x 2 accumulators hide the latency of two multipliers
#else
constexpr int kStripRows = 4;  // limited by 16 registers
#endif

// c[kStripRows, vectors] = end(begin + a b) over `depth`; row m of `a` starts at a + m * a_row and advances by a_step.
// `begin` and `end` receive the row and column of a vector of c, which starts at `row` and `column`.
template <class R, int vectors, class Begin, class End>
GRAINGS_INLINE void strip(int64_t depth, const R* a, int64_t a_row, int64_t a_step, const R* b, int64_t b_row, R* c, int64_t c_row, int64_t row, int64_t column, Begin begin, End end) {
    constexpr int width = kNative<R>;
    Native<R> sums[kStripRows][vectors];
    for (int m = 0; m < kStripRows; m++)
        for (int v = 0; v < vectors; v++) sums[m][v] = begin(row + m, column + v * width).v;
    for (int64_t k = 0; k < depth; k++) {
        Native<R> factors[vectors];
        for (int v = 0; v < vectors; v++) factors[v] = load<width>(b + k * b_row + v * width).v;
        for (int m = 0; m < kStripRows; m++) {
            const Native<R> factor = splat<R, width>(a[m * a_row + k * a_step]).v;
            for (int v = 0; v < vectors; v++) sums[m][v] = fused(factor, factors[v], sums[m][v]);
        }
    }
    for (int m = 0; m < kStripRows; m++)
        for (int v = 0; v < vectors; v++) store(c + (row + m) * c_row + column + v * width, end(Vec<R, width>{sums[m][v]}, row + m, column + v * width));
}

// c[rows, columns] = end(begin + a b). `rows` is a multiple of kStripRows and `columns` of kNetworkPad. Rows of b advance
// by b_row, panels of kPanel columns by b_panel: a packed panel uses all sets of the first-level cache, whereas
// rows of 128 numbers would use an eighth of them.
template <class R, class Begin, class End>
GRAINGS_INLINE void multiply(int64_t rows, int64_t columns, int64_t depth, const R* a, int64_t a_row, int64_t a_step, const R* b, int64_t b_row, int64_t b_panel, R* c, int64_t c_row, Begin begin, End end) {
    constexpr int64_t width = kNative<R>;
    static_assert(kPanel % (2 * width) == 0);
    int64_t column = 0;
    for (; column + 2 * width <= columns; column += 2 * width) {
        const R* from = b + column / kPanel * b_panel + column % kPanel;
        for (int64_t m = 0; m < rows; m += kStripRows) strip<R, 2>(depth, a + m * a_row, a_row, a_step, from, b_row, c, c_row, m, column, begin, end);
    }
    for (; column < columns; column += width) {
        const R* from = b + column / kPanel * b_panel + column % kPanel;
        for (int64_t m = 0; m < rows; m += kStripRows) strip<R, 1>(depth, a + m * a_row, a_row, a_step, from, b_row, c, c_row, m, column, begin, end);
    }
}

GRAINGS_INLINE int64_t whole_strips(int64_t rows) { return (rows + kStripRows - 1) / kStripRows * kStripRows; }

// Rows [begin, begin + rows) of `from` [., width] into `to` [., padded], padded with zeros.
template <class R>
GRAINGS_INLINE void take_rows(const R* from, int64_t begin, int64_t rows, int64_t width, R* to, int64_t padded) {
    for (int64_t r = 0; r < rows; r++) {
        if (width) std::memcpy(to + r * padded, from + (begin + r) * width, sizeof(R) * size_t(width));
        std::memset(to + r * padded + width, 0, sizeof(R) * size_t(padded - width));
    }
}

// Pointers to the activations of the block of rows that begins at `row`.
template <class R>
GRAINGS_INLINE void place(const NetworkArgs<R>& args, int64_t row, R* scratch, R** levels) {
    for (int l = 0; l <= args.layers; l++) levels[l] = scratch + args.offsets[l];
    if (!args.hidden) return;
    R* block = args.hidden + row / kNetworkRows * (args.offsets[args.layers] - args.offsets[1]);
    for (int l = 1; l < args.layers; l++) levels[l] = block + (args.offsets[l] - args.offsets[1]);
}

// Initialises the first layer of a block of rows: the bias plus the row of `shared` of the row's group.
template <class R>
GRAINGS_INLINE void begin_rows(const NetworkArgs<R>& args, int64_t row, int64_t rows, int64_t strips, R* to) {
    const int64_t out = args.padded[1], width = args.widths[1];
    for (int64_t r = 0; r < strips; r++) std::memcpy(to + r * out, args.biases[0], sizeof(R) * size_t(out));
    for (int64_t r = 0; r < rows; r++) {
        const R* shared = args.shared + args.groups[row + r] * width;
        for (int64_t c = 0; c < width; c++) to[r * out + c] += shared[c];
    }
}

// Adds the gradient of a block's first layer to that of `shared`. Pieces run concurrently: the part of a group that began
// in an earlier piece is stored separately and added later.
template <class R>
GRAINGS_INLINE void add_to_groups(const NetworkArgs<R>& args, int64_t begin, int64_t row, int64_t rows, const R* above, R* sums) {
    const int64_t out = args.padded[1], width = args.widths[1], before = begin ? args.groups[begin - 1] : -1;
    for (int64_t r = 0; r < rows; r++) {
        const int64_t group = args.groups[row + r];
        R* to = group == before ? sums + args.first_group_at : args.v_shared + group * width;
        for (int64_t c = 0; c < width; c++) to[c] += above[r * out + c];
    }
}

// Output rows [begin, end). ReLU passes NaN.
template <class R>
static void network_values(const NetworkArgs<R>& args, int64_t begin, int64_t end, R* scratch) {
    constexpr int width = kNative<R>;
    const auto zero = splat<R, width>(R(0));
    R* levels[kMaxLayers + 1];
    for (int64_t row = begin; row < end; row += kNetworkRows) {
        const int64_t rows = end - row < kNetworkRows ? end - row : kNetworkRows, strips = whole_strips(rows);
        place(args, row, scratch, levels);
        take_rows(args.input, row, rows, args.widths[0], levels[0], args.padded[0]);
        for (int l = 0; l < args.layers; l++) {
            const int64_t in = args.padded[l], out = args.padded[l + 1];
            R* to = levels[l + 1];
            const R* bias = args.biases[l];
            const auto values = [&](auto begin, auto end) { multiply(strips, out, args.widths[l], levels[l], in, int64_t(1), args.forward[l], kPanel, in * kPanel, to, out, begin, end); };
            const auto biased = [&](auto end) {
                if (l > 0 || !args.shared) return values([&](int64_t, int64_t c) { return load<width>(bias + c); }, end);
                begin_rows(args, row, rows, strips, to);
                values([&](int64_t r, int64_t c) { return load<width>(to + r * out + c); }, end);
            };
            if (l + 1 < args.layers) biased([&](auto sum, int64_t, int64_t) { return max(zero, sum); });
            else biased([](auto sum, int64_t, int64_t) { return sum; });
        }
        const int64_t last = args.widths[args.layers];
        for (int64_t r = 0; r < rows; r++) std::memcpy(args.output + (row + r) * last, levels[args.layers] + r * args.padded[args.layers], sizeof(R) * size_t(last));
    }
}

// Gradients of rows [begin, end): those of the input are written to v_input, those of weights and biases added to `sums`.
template <class R>
static void network_gradient(const NetworkArgs<R>& args, int64_t begin, int64_t end, R* sums, R* scratch) {
    constexpr int width = kNative<R>;
    R* levels[kMaxLayers + 1];
    R *above = scratch + args.offsets[args.layers + 1], *below = above + args.widest * kNetworkRows;
    for (int64_t row = begin; row < end; row += kNetworkRows) {
        const int64_t rows = end - row < kNetworkRows ? end - row : kNetworkRows, strips = whole_strips(rows);
        place(args, row, scratch, levels);
        take_rows(args.input, row, rows, args.widths[0], levels[0], args.padded[0]);
        take_rows(args.v_output, row, rows, args.widths[args.layers], above, args.padded[args.layers]);
        for (int l = args.layers - 1; l >= 0; l--) {
            const int64_t in = args.padded[l], out = args.padded[l + 1];
            R *weight = sums + args.weight_at[l], *bias = sums + args.bias_at[l];
            const auto as_is = [](auto sum, int64_t, int64_t) { return sum; };
            multiply(out, in, rows, above, int64_t(1), out, levels[l], in, kPanel, weight, in, [&](int64_t r, int64_t c) { return load<width>(weight + r * in + c); }, as_is);
            for (int64_t c = 0; c < out; c += width) {
                auto sum = load<width>(bias + c);
                for (int64_t r = 0; r < rows; r++) sum = sum + load<width>(above + r * out + c);
                store(bias + c, sum);
            }
            if (l == 0 && args.shared) add_to_groups(args, begin, row, rows, above, sums);
            if (l == 0 && !args.v_input) break;
            const auto zero = splat<R, width>(R(0));
            const auto backwards = [&](auto end) { multiply(strips, in, args.widths[l + 1], above, out, int64_t(1), args.backward[l], kPanel, out * kPanel, below, in, [&](int64_t, int64_t) { return zero; }, end); };
            if (l == 0) {
                backwards(as_is);
                for (int64_t r = 0; r < rows; r++) std::memcpy(args.v_input + (row + r) * args.widths[0], below + r * in, sizeof(R) * size_t(args.widths[0]));
                break;
            }
            backwards([&](auto sum, int64_t r, int64_t c) { return select(load<width>(levels[l] + r * in + c) <= zero, zero, sum); });
            R* done = above;
            above = below, below = done;
        }
    }
}

}  // namespace graings::GRAINGS_ISA
