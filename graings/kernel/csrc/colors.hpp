// Colours of the drawn children from the outputs of their networks (Eq. 11 to 13), and the adjoint.
#pragma once
#include <cstdint>

namespace graings {

// A child is a row of `color` and `residual`; those drawn ascend.
template <class R>
struct ColorOutputs {
    int64_t slots, drawn;
    const int64_t* children;  // [drawn]
    const R *color, *residual;  // [slots, 3]; [slots, 4]: of the colour and of the opacity, or null
    double bound;               // eta
    bool projected;             // clipped colours receive gradients that move them back inside
};

// change [drawn, 4] = bound tanh(residual); sum [drawn, 3] = sigmoid(color) + change; drawn_color [drawn, 3] = sum within [0, 1].
// Without a residual only sum is written: it needs no bounds. Throws std::invalid_argument when children do not ascend.
template <class R>
void child_colors(const ColorOutputs<R>&, R* change, R* sum, R* drawn_color, int threads);

// v_color [slots, 3] and v_residual [slots, 4] from the gradients of the colours and of `change`; zero for slots that are not
// drawn. Either gradient may be null for zero; v_residual is null if residual is. `sum` is that of `child_colors`.
template <class R>
void child_colors_gradient(const ColorOutputs<R>&, const R* sum, const R* v_drawn_color, const R* v_change, R* v_color, R* v_residual, int threads);

}  // namespace graings
