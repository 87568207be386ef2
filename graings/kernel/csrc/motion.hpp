// The Gaussians of one instant from what does not change in time: offsets, then Eq. 10.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

// A NaN passes, so that later checks find it.
template <class R, int N> GRAINGS_INLINE Vec<R, N> clip(Vec<R, N> x, R low, R high) {
    const auto least = splat<R, N>(low), most = splat<R, N>(high);
    return select(x < least, least, select(most < x, most, x));
}

// Mean, quaternion and log-scale of the children in one register, from lane `lane` of a block. Sums and products have the
// order of layers.hpp and children.cpp, which gives them the same bits.
template <class R>
GRAINGS_INLINE void move_lanes(const MoveArgs<R>& args, int64_t block, int lane, R (&moved)[kOffsets][kMoving]) {
    constexpr int N = kNative<R>;
    using V = Vec<R, N>;
    V offset[kOffsets];
    for (int c = 0; c < kOffsets; c++) offset[c] = splat<R, N>(args.bias[c]);
    for (int64_t k = args.begin[block]; k < args.begin[block + 1]; k++) {
        constexpr int kAhead = 24;  // units: a block crosses pages, where the CPU stops reading ahead
        __builtin_prefetch(args.hidden + (k + kAhead) * kMoving + lane);
        const V unit = load<N>(args.hidden + k * kMoving + lane);
        const R* weights = args.weights + args.units[k] * kOffsets;
        for (int c = 0; c < kOffsets; c++) offset[c] = fma(unit, splat<R, N>(weights[c]), offset[c]);
    }
    const R* rest = args.rest + block * kOffsets * kMoving + lane;
    V base[kOffsets], result[kOffsets];
    for (int c = 0; c < kOffsets; c++) base[c] = load<N>(rest + c * kMoving);
    const auto extent = splat<R, N>(args.extent);
    for (int c = 0; c < 3; c++) result[c] = base[c] + offset[c] * extent;
    const V aw = base[3], ax = base[4], ay = base[5], az = base[6];
    const V bw = offset[3] + splat<R, N>(R(1)), bx = offset[4], by = offset[5], bz = offset[6];
    result[3] = aw * bw - ax * bx - ay * by - az * bz, result[4] = aw * bx + ax * bw + ay * bz - az * by;
    result[5] = aw * by - ax * bz + ay * bw + az * bx, result[6] = aw * bz + ax * by - ay * bx + az * bw;
    for (int c = 7; c < kOffsets; c++) result[c] = clip(base[c] + clip(offset[c], -args.change, args.change), args.low, args.high);
    for (int c = 0; c < kOffsets; c++) store(moved[c] + lane, result[c]);
}

// Entries [begin, end) of `rows`; ascending rows share the work of their block.
template <class R>
static void move_children(const MoveArgs<R>& args, int64_t begin, int64_t end) {
    R moved[kOffsets][kMoving];
    while (begin < end) {
        const int64_t block = args.rows[begin] / kMoving;
        for (int lane = 0; lane < kMoving; lane += kNative<R>) move_lanes(args, block, lane, moved);
        for (; begin < end && args.rows[begin] / kMoving == block; begin++) {
            const int64_t at = args.rows[begin] % kMoving;
            for (int c = 0; c < 3; c++) args.mean[3 * begin + c] = moved[c][at], args.log_scale[3 * begin + c] = moved[7 + c][at];
            for (int c = 0; c < 4; c++) args.quat[4 * begin + c] = moved[3 + c][at];
        }
    }
}

// Blocks [begin, end) of BlendArgs.
template <class R>
static void blend_children(const BlendArgs<R>& args, int64_t begin, int64_t end) {
    constexpr int N = kNative<R>;
    R values[kBlended][kMoving];
    for (int64_t block = begin; block < end; block++) {
        for (int lane = 0; lane < kMoving; lane += N) {
            Vec<R, N> sum[kBlended];
            for (int c = 0; c < kBlended; c++) sum[c] = load<N>(args.state + (block * kBlended + c) * kMoving + lane);
            for (int64_t k = args.begin[block]; k < args.begin[block + 1]; k++) {
                const auto weight = load<N>(args.weights + k * kMoving + lane);
                const R* function = args.functions + args.units[k] * kBlended;
                for (int c = 0; c < kBlended; c++) sum[c] = fma(weight, splat<R, N>(function[c]), sum[c]);
            }
            for (int c = 0; c < kBlended; c++) store(values[c] + lane, sum[c]);
        }
        R* out = args.out + block * kMoving * kBlended;
        for (int i = 0; i < kMoving; i++)
            for (int c = 0; c < kBlended; c++) out[i * kBlended + c] = values[c][i];
    }
}

}  // namespace graings::GRAINGS_ISA
