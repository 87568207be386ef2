// A network packed for the loops of layers.hpp.
#pragma once
#include <algorithm>

#include "buffer.hpp"
#include "perceptron.hpp"

namespace graings {

inline int64_t up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }

// Index of an element of a matrix of `rows` rows that is stored in panels of kPanel columns.
inline int64_t in_panels(int64_t row, int64_t column, int64_t rows) { return (column / kPanel * rows + row) * kPanel + column % kPanel; }

// The weights packed into panels, for both passes, padded with zeros.
template <class R>
struct Packed {
    NetworkArgs<R> args{};
    int64_t scratch = 0, sums = 0;  // elements
    Buffer<R> numbers;

    Packed(const Network<R>& network, const R* input, R* hidden, bool gradient) {
        args.layers = int(network.weights.size());
        args.input = input, args.hidden = hidden, args.shared = network.shared, args.groups = network.group;
        int64_t size = 0;
        for (int l = 0; l <= args.layers; l++) {
            args.widths[l] = network.widths[size_t(l)], args.padded[l] = up(args.widths[l], kNetworkPad);
            args.widest = std::max(args.widest, args.padded[l]);
            args.offsets[l] = scratch, scratch += args.padded[l] * kNetworkRows;
        }
        args.offsets[args.layers + 1] = scratch;
        if (gradient) scratch += 2 * args.widest * kNetworkRows;
        for (int l = 0; l < args.layers; l++) {
            const int64_t weight = args.padded[l] * args.padded[l + 1];
            args.weight_at[l] = sums, args.bias_at[l] = sums + weight, sums += weight + args.padded[l + 1];
            size += args.padded[l] * up(args.padded[l + 1], kPanel) + args.padded[l + 1];
            if (gradient) size += args.padded[l + 1] * up(args.padded[l], kPanel);
        }
        args.first_group_at = sums;
        numbers = Buffer<R>(size_t(size));
        std::fill_n(numbers.get(), size, R(0));
        R* at = numbers.get();
        for (int l = 0; l < args.layers; l++) {
            const int64_t in = args.padded[l], out = args.padded[l + 1], ins = args.widths[l], outs = args.widths[l + 1];
            const R* weight = network.weights[size_t(l)];
            R *forward = at, *bias = at + in * up(out, kPanel), *backward = bias + out;
            for (int64_t o = 0; o < outs; o++)
                for (int64_t i = 0; i < ins; i++) {
                    forward[in_panels(i, o, in)] = weight[o * ins + i];
                    if (gradient) backward[in_panels(o, i, out)] = weight[o * ins + i];
                }
            std::copy_n(network.biases[size_t(l)], outs, bias);
            args.forward[l] = forward, args.biases[l] = bias, args.backward[l] = backward;
            at = gradient ? backward + out * up(in, kPanel) : backward;
        }
    }
};

}  // namespace graings
