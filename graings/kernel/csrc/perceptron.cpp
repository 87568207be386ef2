#include "perceptron.hpp"

#include <algorithm>
#include <stdexcept>

#include "buffer.hpp"
#include "isa.hpp"
#include "packed.hpp"
#include "pool.hpp"

namespace graings {
namespace {

// Rows per piece of work and per set of partial sums: fixed, so that sums do not depend on the number of threads.
template <class R, class Stored>
constexpr int64_t kPieceRows = (Packing<R, Stored>::kRounded ? 16 : 8) * kNetworkRows;

template <class R, class Stored>
const auto& loops() {
    if constexpr (std::is_same_v<R, Stored>) return kernels<R>();
    else return bfloat16_kernels();
}

template <class R, class Stored>
void evaluate_as(const Network<R>& network, int64_t rows, const R* input, R* output, R* hidden, int threads) {
    for (int64_t row = 0; network.shared && row < rows; row++)
        if (network.group[row] < (row ? network.group[row - 1] : 0) || network.group[row] >= network.groups)
            throw std::invalid_argument("groups must ascend and be rows of shared");
    constexpr int64_t kPiece = kPieceRows<R, Stored>;
    Packed<R, Stored> packed(network, input, hidden, false);
    packed.args.output = output;
    const int64_t pieces = up(rows, kPiece) / kPiece;
    Buffer<R> scratch(size_t(threads) * size_t(packed.scratch));
    parallel_for(threads, pieces, [&](int worker, int64_t piece) {
        loops<R, Stored>().network_values(packed.args, piece * kPiece, std::min(rows, (piece + 1) * kPiece), scratch.get() + worker * packed.scratch);
    });
}

template <class R, class Stored>
void differentiate_as(const Network<R>& network, int64_t rows, const R* input, R* hidden, const R* v_output, R* v_input, const std::vector<R*>& v_weights, const std::vector<R*>& v_biases, R* v_shared, int threads) {
    constexpr int64_t kPiece = kPieceRows<R, Stored>;
    Packed<R, Stored> packed(network, input, hidden, true);
    NetworkArgs<R, Stored>& args = packed.args;
    args.v_output = v_output, args.v_input = v_input, args.v_shared = v_shared;
    if (args.shared) std::fill_n(v_shared, network.groups * args.widths[1], R(0));
    const int64_t pieces = up(rows, kPiece) / kPiece, stride = packed.sums + (args.shared ? args.padded[1] : 0);
    Buffer<R> scratch(size_t(threads) * size_t(packed.scratch)), sums(size_t(std::max<int64_t>(pieces, 1)) * size_t(stride));
    std::fill_n(sums.get(), stride, R(0));
    parallel_for(threads, pieces, [&](int worker, int64_t piece) {
        R* own = sums.get() + piece * stride;
        std::fill_n(own, stride, R(0));
        loops<R, Stored>().network_gradient(args, piece * kPiece, std::min(rows, (piece + 1) * kPiece), own, scratch.get() + worker * packed.scratch);
    });
    for (int64_t piece = 1; piece < pieces; piece++) {
        const R* own = sums.get() + piece * stride;
        for (int64_t i = 0; i < packed.sums; i++) sums[size_t(i)] += own[i];
        if (!args.shared) continue;
        R* to = v_shared + args.groups[piece * kPiece - 1] * args.widths[1];
        for (int64_t c = 0; c < args.widths[1]; c++) to[c] += own[args.first_group_at + c];
    }
    for (int l = 0; l < args.layers; l++) {
        const int64_t ins = args.widths[l], outs = args.widths[l + 1];
        for (int64_t o = 0; o < outs; o++) std::copy_n(sums.get() + args.weight_at[l] + o * args.padded[l], ins, v_weights[size_t(l)] + o * ins);
        std::copy_n(sums.get() + args.bias_at[l], outs, v_biases[size_t(l)]);
    }
}

}  // namespace

int64_t hidden_size(const std::vector<int64_t>& widths, int64_t rows, Products products) {
    using Rounded = Packing<float, Bfloat16>;
    int64_t row = 0;
    for (size_t l = 1; l + 1 < widths.size(); l++) row += products == kAsStored ? up(widths[l], kNetworkPad) : up(widths[l], Rounded::kPad) / Rounded::kStoredPerNumber;
    return row * up(rows, kNetworkRows);
}

template <class R>
void evaluate(const Network<R>& network, int64_t rows, const R* input, R* output, R* hidden, Products products, int threads) {
    if constexpr (std::is_same_v<R, float>)
        if (products == kInBfloat16) return evaluate_as<R, Bfloat16>(network, rows, input, output, hidden, threads);
    evaluate_as<R, R>(network, rows, input, output, hidden, threads);
}

template <class R>
void differentiate(const Network<R>& network, int64_t rows, const R* input, R* hidden, const R* v_output, R* v_input, const std::vector<R*>& v_weights, const std::vector<R*>& v_biases, R* v_shared,
                   Products products, int threads) {
    if constexpr (std::is_same_v<R, float>)
        if (products == kInBfloat16) return differentiate_as<R, Bfloat16>(network, rows, input, hidden, v_output, v_input, v_weights, v_biases, v_shared, threads);
    differentiate_as<R, R>(network, rows, input, hidden, v_output, v_input, v_weights, v_biases, v_shared, threads);
}

#define GRAINGS_INSTANTIATE(R)                                                                         \
    template void evaluate<R>(const Network<R>&, int64_t, const R*, R*, R*, Products, int);            \
    template void differentiate<R>(const Network<R>&, int64_t, const R*, R*, const R*, R*, const std::vector<R*>&, const std::vector<R*>&, R*, Products, int);
GRAINGS_INSTANTIATE(float)
GRAINGS_INSTANTIATE(double)
#undef GRAINGS_INSTANTIATE

}  // namespace graings
