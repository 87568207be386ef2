// A clip with the gradient of graings/scene/clip.py.
#pragma once

namespace graings {

// A NaN passes, so that later checks find it.
template <class R> R clip(R x, R low, R high) { return x < low ? low : x > high ? high : x; }

// The gradient through a clip of x.
template <class R>
R clip_gradient(R v, R x, R low, R high, bool projected) {
    if (x > high) return projected && v > R(0) ? v : R(0);
    if (x < low) return projected && v < R(0) ? v : R(0);
    return v;
}

}  // namespace graings
