// Parts of a scene prepared for rendering: geometry of one instant, colours of one view.
#pragma once
#include <cstdint>

#include "children.hpp"
#include "perceptron.hpp"
#include "types.hpp"

namespace graings {

// out [count] = sigmoid or tanh of x; the same bits wherever a number stands.
template <class R>
void activate(Activation, int64_t count, const R* x, R* out, int threads);

// out [count] = v times the derivative at x.
template <class R>
void activate_gradient(Activation, int64_t count, const R* x, const R* v, R* out, int threads);

// out [rows, 3]: unit vectors from `eye` to the positions [rows, 3]; a distance below `nearest` counts as that.
template <class R>
void directions(int64_t rows, const R* position, const double* eye, double nearest, R* out, int threads);

// The children that may be shown: row r is slot `slots[r]` of the kept anchors.
template <class R>
struct Shown {
    int64_t count, anchors;
    const int64_t *slots, *children, *uids;  // [count] each: of each row; slots ascend
    const R* opacities;                      // [slots of all kept anchors]: canonical scores
    Network<R> residual;                     // no inputs but `shared` -> values of each slot, the last for its score; or empty
    R* change;                               // [anchors, outputs of `residual`]: written; null if there is none
    const R* blended;                        // [count, kBlended] instead of `residual`: added without a bound; or null
    double bound, threshold;                 // eta; scores up to `threshold` are not rendered
};

// Values [blocks, kMoving, kBlended] of a motion basis.
template <class R>
void blend(const BlendArgs<R>&, int64_t blocks, int threads);

// The rendered rows in ascending order, at the front of arrays of `count`.
template <class R>
struct Rendered {
    int64_t *rows, *slots, *children, *uids;
    R* opacities;
    R* changes;  // [count, 3]: the colours of `blended`; null if there are none
};

// Selects the rows whose score, opacity + bound tanh(change) or opacity + blended, exceeds the threshold; returns their number.
// Throws std::invalid_argument for a slot without an opacity.
template <class R>
int64_t choose(const Shown<R>&, int64_t slots, const Rendered<R>&, int threads);

// Geometry of `drawn` of `children` children, see MoveArgs. Throws std::invalid_argument for a row out of range.
template <class R>
void move(const MoveArgs<R>&, int64_t children, int64_t drawn, int threads);

// The networks of colour of a scene's anchors, without the feature's part of their first layer, which is `shared`.
template <class R>
struct ColorNetworks {
    int64_t anchors, slots;
    const R *position, *normals;  // [anchors, 3] each; normals of the reflection or null
    int degree;                   // of the harmonics that `canonical` receives
    Network<R> canonical;         // encoded directions -> [3 slots]
    int residual_degree;          // of those that `residual` receives; 0: there is no such network
    Network<R> residual;          // encoded directions -> [3 slots], before its bound
    const R* time_only;           // [anchors, slots, 4] without `residual`: colour, opacity; or null
    const R* blended;             // [drawn, 3] instead of both: a change that has its bound already; or null
    double bound;                 // eta
};

// What a camera can see: see graings/camera/frustum.py, which has these numbers in this order.
struct Frustum {
    double rotation[9], center[3], fx, fy, cx, cy, width, height, near, constant, spread;
};

// The children whose colours are wanted. Without a frustum those of all; else, of the children at mean [drawn, 3] with
// log_scale [drawn, 3], of those that its camera may see, and at least of these.
template <class R>
struct Wanted {
    int64_t drawn;
    const int64_t* children;  // anchor * slots + slot, ascending
    const Frustum* frustum;
    const R *mean, *log_scale;
};

// colors [drawn, 3] of the wanted children seen from `eye`, Eq. 11 to 13; 0 for the others.
// Throws std::invalid_argument when children do not ascend.
template <class R>
void paint(const ColorNetworks<R>&, const double* eye, double nearest, const Wanted<R>&, R* colors, int threads);

}  // namespace graings
