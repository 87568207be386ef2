// Frequency encoding of positions. Knows nothing of what reads it.
#pragma once
#include <cstdint>

namespace graings {

// out [rows, dimensions * (1 + 2 octaves)] of x [rows, dimensions]: x, then sin(2^l x) and then cos(2^l x), the octaves
// l of a coordinate side by side. Values are those of float64, rounded to R.
template <class R>
void encode(int64_t rows, int64_t dimensions, int octaves, const R* x, R* out, int threads);

}  // namespace graings
