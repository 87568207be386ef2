// A small network evaluated on many rows: layout of scratch memory, packing of weights, and division into pieces.
#pragma once
#include <vector>
#include "types.hpp"

namespace graings {

// `widths` has one entry per level, input first; weights[l] is [widths[l + 1], widths[l]] row by row. ReLU
// between layers, none after the last. Rows may belong to groups, in ascending order, each of which
// adds its row of `shared` [groups, widths[1]] to the first layer: inputs common to a group are then multiplied once.
template <class R>
struct Network {
    std::vector<int64_t> widths;
    std::vector<const R*> weights, biases;
    const R* shared = nullptr;
    const int64_t* group = nullptr;  // of each row
    int64_t groups = 0;
};

// Whether products are of the numbers as they are, or of numbers rounded to bfloat16; the latter for float32 and where
// has_bfloat16_products() (isa.hpp).
enum Products { kAsStored, kInBfloat16 };

// Number of elements of the hidden activations of so many rows.
int64_t hidden_size(const std::vector<int64_t>& widths, int64_t rows, Products);

// output [rows, widths.back()] of input [rows, widths.front()]. `hidden` may be null if no gradient is needed.
// Throws std::invalid_argument if groups do not ascend within their count.
template <class R>
void evaluate(const Network<R>&, int64_t rows, const R* input, R* output, R* hidden, Products, int threads);

// Gradients for `v_output`, with `hidden` as evaluate left it for the same products; `v_input` may be null, and `v_shared` if
// `shared` is. The same bits for any number of threads.
template <class R>
void differentiate(const Network<R>&, int64_t rows, const R* input, R* hidden, const R* v_output, R* v_input, const std::vector<R*>& v_weights, const std::vector<R*>& v_biases, R* v_shared, Products, int threads);

}  // namespace graings
