// Frequency encoding of positions and times, and spherical harmonics of directions.
#pragma once
#include <cstdint>

namespace graings {

// out [rows, dimensions * (1 + 2 octaves)] of x [rows, dimensions]: x, then sin(2^l x) and then cos(2^l x), the octaves
// l of a coordinate side by side. Values are those of float64, rounded to R.
template <class R>
void encode(int64_t rows, int64_t dimensions, int octaves, const R* x, R* out, int threads);

// out [rows, width] of unit vectors [rows, 3]: real spherical harmonics of degrees 1 to `degree`, at most 3, scaled so that
// the first three are the direction itself; width = degree (degree + 2). With `normals` [rows, 3], of any length, the
// harmonics of the reflected directions follow.
template <class R>
void encode_directions(int64_t rows, int degree, const R* directions, const R* normals, R* out, int threads);

// The gradient with respect to `normals`.
template <class R>
void encode_directions_gradient(int64_t rows, int degree, const R* directions, const R* normals, const R* v_out, R* v_normals, int threads);

}  // namespace graings
