// A network packed for the loops of layers.hpp or bfloat16.cpp.
#pragma once
#include <algorithm>
#include <cstring>
#include <type_traits>

#include "buffer.hpp"
#include "perceptron.hpp"

namespace graings {

inline int64_t up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }

// Index of an element of a matrix of `rows` rows that is stored in panels of kPanel columns.
inline int64_t in_panels(int64_t row, int64_t column, int64_t rows) { return (column / kPanel * rows + row) * kPanel + column % kPanel; }

// The same of tiles: of kTileColumns columns, whose rows are stored in interleaved pairs.
inline int64_t in_tiles(int64_t row, int64_t column, int64_t rows) {
    return column / kTileColumns * kTileColumns * rows + row / 2 * 2 * kTileColumns + column % kTileColumns * 2 + row % 2;
}

// Rounded to nearest even. NaN stays NaN, also where its upper half alone would be infinite.
inline Bfloat16 to_bfloat16(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    if (x != x) return Bfloat16(bits >> 16 | 0x40);
    return Bfloat16((bits + 0x7FFF + (bits >> 16 & 1)) >> 16);
}

// How the loops of a network want it: `Stored` is R, or Bfloat16 where R is float.
template <class R, class Stored>
struct Packing {
    static constexpr bool kRounded = !std::is_same_v<R, Stored>;
    static constexpr int64_t kPad = kRounded ? kTileDepth : kNetworkPad;
    static constexpr int64_t kStoredPerNumber = int64_t(sizeof(R) / sizeof(Stored));
    static int64_t size(int64_t rows, int64_t columns) { return rows * up(columns, kPanel); }
    static int64_t index(int64_t row, int64_t column, int64_t rows) { return kRounded ? in_tiles(row, column, rows) : in_panels(row, column, rows); }
    static Stored stored(R x) {
        if constexpr (kRounded) return to_bfloat16(x);
        else return x;
    }
};

// The weights packed for both passes, padded with zeros.
template <class R, class Stored = R>
struct Packed {
    using To = Packing<R, Stored>;
    NetworkArgs<R, Stored> args{};
    int64_t scratch = 0, sums = 0;  // elements of R
    Buffer<R> biases;
    Buffer<Stored> weights;

    Packed(const Network<R>& network, const R* input, R* hidden, bool gradient) {
        args.layers = int(network.weights.size());
        args.input = input, args.hidden = reinterpret_cast<Stored*>(hidden), args.shared = network.shared, args.groups = network.group;
        int64_t level = 0, size = 0, bias_size = 0;
        for (int l = 0; l <= args.layers; l++) {
            args.widths[l] = network.widths[size_t(l)], args.padded[l] = up(args.widths[l], To::kPad);
            args.widest = std::max(args.widest, args.padded[l]);
            args.offsets[l] = level, level += args.padded[l] * kNetworkRows;
        }
        args.offsets[args.layers + 1] = level;
        if constexpr (To::kRounded) scratch = (level + 4 * args.widest * kNetworkRows) / To::kStoredPerNumber + 2 * kTileColumns * kNetworkRows;
        else scratch = level + (gradient ? 2 * args.widest * kNetworkRows : 0);
        for (int l = 0; l < args.layers; l++) {
            args.weight_at[l] = sums, args.bias_at[l] = sums + args.padded[l] * args.padded[l + 1], sums = args.bias_at[l] + args.padded[l + 1];
            size += To::size(args.padded[l], args.padded[l + 1]) + (gradient ? To::size(args.padded[l + 1], args.padded[l]) : 0);
            bias_size += args.padded[l + 1];
        }
        args.first_group_at = sums;
        weights = Buffer<Stored>(size_t(size)), biases = Buffer<R>(size_t(bias_size));
        std::fill_n(weights.get(), size, Stored(0)), std::fill_n(biases.get(), bias_size, R(0));
        Stored* at = weights.get();
        R* bias = biases.get();
        for (int l = 0; l < args.layers; l++) {
            const int64_t in = args.padded[l], out = args.padded[l + 1], ins = args.widths[l], outs = args.widths[l + 1];
            const R* weight = network.weights[size_t(l)];
            Stored *forward = at, *backward = at + To::size(in, out);
            for (int64_t o = 0; o < outs; o++)
                for (int64_t i = 0; i < ins; i++) {
                    const Stored value = To::stored(weight[o * ins + i]);
                    forward[To::index(i, o, in)] = value;
                    if (gradient) backward[To::index(o, i, out)] = value;
                }
            std::copy_n(network.biases[size_t(l)], outs, bias);
            args.forward[l] = forward, args.biases[l] = bias, args.backward[l] = backward;
            at = gradient ? backward + To::size(out, in) : backward, bias += out;
        }
    }
};

}  // namespace graings
