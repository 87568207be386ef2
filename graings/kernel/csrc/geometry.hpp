// From Gaussians to records and back: projection in float64, eight at a time, whatever the pixels use.
// Formulas: sheared footprint (a determinant without a subtraction) and its adjoint.
#pragma once
#include "simd.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

constexpr int kGroup = 8;
using D = Vec<double, kGroup>;
GRAINGS_INLINE D d8(double x) { return splat<double, kGroup>(x); }

constexpr double kLn2 = 0.6931471805599453;
constexpr double kLog2E = 1.4426950408889634;

// Everything about eight Gaussians that both directions need.
struct Projected {
    D z, inverse_z, ratio_x, ratio_y, held_x, held_y;  // held: clamped before the Jacobian
    D quat[4], inverse_norm, squared;
    D rotation[9], scale[3];
    D affine[6];      // Jacobian times world-to-camera rotation, 2x3
    D m1[3], m2[3];   // rows of the factor of the covariance
    D x, y, slope, v, c, a;
    D finite;         // 0, or not a number
};

struct Limits {
    D low_x, high_x, low_y, high_y;
};

GRAINGS_INLINE Limits limits(const Camera& k, const Settings& s) {
    const double mx = s.frustum_margin * 0.5 * double(k.width), my = s.frustum_margin * 0.5 * double(k.height);
    return {d8(-(k.cx + mx) / k.fx), d8((double(k.width) - k.cx + mx) / k.fx), d8(-(k.cy + my) / k.fy),
            d8((double(k.height) - k.cy + my) / k.fy)};
}

GRAINGS_INLINE D dot3(const D* a, const D* b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }

// Column `column` of a row-major [N, width] array for Gaussians begin..begin+7; past the end the last one repeats.
template <class R>
GRAINGS_INLINE D gather(const R* rows, int width, int column, int64_t begin, int64_t count) {
    double lanes[kGroup];
    for (int i = 0; i < kGroup; i++) {
        const int64_t row = begin + i < count ? begin + i : count - 1;
        lanes[i] = double(rows[row * width + column]);
    }
    return load<kGroup>(lanes);
}

template <class R>
GRAINGS_INLINE Projected project_group(const Camera& k, const Settings& settings, const Inputs<R>& in, int64_t begin) {
    Projected p;
    D mean[3], rho[3], offset[2];
    for (int i = 0; i < 3; i++) mean[i] = gather(in.means, 3, i, begin, in.count);
    for (int i = 0; i < 3; i++) rho[i] = gather(in.log_scales, 3, i, begin, in.count);
    for (int i = 0; i < 4; i++) p.quat[i] = gather(in.quats, 4, i, begin, in.count);
    for (int i = 0; i < 2; i++) offset[i] = in.offset ? gather(in.offset, 2, i, begin, in.count) : d8(0);
    p.finite = d8(0);
    for (int i = 0; i < 3; i++) p.finite = p.finite + (mean[i] - mean[i]) + (rho[i] - rho[i]);
    for (int i = 0; i < 2; i++) p.finite = p.finite + (offset[i] - offset[i]);

    // the difference first, then the rotation: a scene far from the origin does not cancel
    D away[3], camera[3];
    for (int i = 0; i < 3; i++) away[i] = mean[i] - d8(k.center[i]);
    for (int i = 0; i < 3; i++)
        camera[i] = fma(d8(k.rotation[3 * i]), away[0], fma(d8(k.rotation[3 * i + 1]), away[1], d8(k.rotation[3 * i + 2]) * away[2]));
    p.z = camera[2];
    p.inverse_z = d8(1) / p.z;
    p.ratio_x = camera[0] / p.z;
    p.ratio_y = camera[1] / p.z;
    const Limits limit = limits(k, settings);
    p.held_x = clamp(p.ratio_x, limit.low_x, limit.high_x);
    p.held_y = clamp(p.ratio_y, limit.low_y, limit.high_y);

    p.squared = fma(p.quat[0], p.quat[0], fma(p.quat[1], p.quat[1], fma(p.quat[2], p.quat[2], p.quat[3] * p.quat[3])));
    p.finite = p.finite + (p.squared - p.squared);
    p.inverse_norm = d8(1) / sqrt(p.squared);
    for (int i = 0; i < 4; i++) p.quat[i] = p.quat[i] * p.inverse_norm;
    const D w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3], one = d8(1), two = d8(2);
    D* r = p.rotation;
    r[0] = one - two * fma(y, y, z * z), r[1] = two * (x * y - w * z), r[2] = two * fma(x, z, w * y);
    r[3] = two * fma(x, y, w * z), r[4] = one - two * fma(x, x, z * z), r[5] = two * (y * z - w * x);
    r[6] = two * (x * z - w * y), r[7] = two * fma(y, z, w * x), r[8] = one - two * fma(x, x, y * y);
    for (int i = 0; i < 3; i++) p.scale[i] = exp(rho[i]);

    const D fx = d8(k.fx) * p.inverse_z, fy = d8(k.fy) * p.inverse_z;
    for (int i = 0; i < 3; i++) {
        const D forward = d8(k.rotation[6 + i]);
        p.affine[i] = fx * (d8(k.rotation[i]) - p.held_x * forward);
        p.affine[3 + i] = fy * (d8(k.rotation[3 + i]) - p.held_y * forward);
    }
    for (int j = 0; j < 3; j++) {
        const D* a = p.affine;
        p.m1[j] = fma(a[0], r[j], fma(a[1], r[3 + j], a[2] * r[6 + j])) * p.scale[j];
        p.m2[j] = fma(a[3], r[j], fma(a[4], r[3 + j], a[5] * r[6 + j])) * p.scale[j];
    }
    const D xx = dot3(p.m1, p.m1), yy = dot3(p.m2, p.m2), xy = dot3(p.m1, p.m2), h = d8(settings.blur);
    const D cross[3] = {p.m1[1] * p.m2[2] - p.m1[2] * p.m2[1], p.m1[2] * p.m2[0] - p.m1[0] * p.m2[2],
                        p.m1[0] * p.m2[1] - p.m1[1] * p.m2[0]};
    const D determinant = fma(h, h, fma(h, xx + yy, dot3(cross, cross)));  // Lagrange's identity
    p.a = xx + h;
    p.c = yy + h;
    p.slope = xy / p.c;
    p.v = determinant / p.c;
    p.x = fma(d8(k.fx), p.ratio_x, d8(k.cx)) + offset[0];
    p.y = fma(d8(k.fy), p.ratio_y, d8(k.cy)) + offset[1];
    return p;
}

template <class R>
static void project(const ProjectArgs<R>& args, int64_t begin, int64_t end) {
    const Settings& s = args.settings;
    const Inputs<R>& in = args.in;
    const double width = double(args.camera.width), height = double(args.camera.height);
    for (int64_t group = begin; group < end; group += kGroup) {
        const Projected p = project_group(args.camera, s, in, group);
        const D footprint = (p.x - p.x) + (p.y - p.y) + (p.slope - p.slope) + (p.v - p.v) + (p.c - p.c) + (p.a - p.a);
        const D sr = sqrt(d8(0.5 * kLog2E) / p.v), sy = sqrt(d8(0.5 * kLog2E) / p.c);
        // Beyond `level` nothing is drawn. The pixel decides; extents only save work, so they are widened by more than
        // any rounding of the exponent.
        const D level = s.alpha_min > 0 ? log2(gather(in.opacities, 1, 0, group, in.count) / d8(s.alpha_min)) : d8(1e30);
        const D widened = min(fma(level, d8(1 + 1e-5), d8(1e-5)), d8(1e30)), tilt = p.slope * sr / sy, root = sqrt(widened);
        const D high = root / sy, wide = root * sqrt(fma(tilt, tilt, d8(1))) / sr;
        double finite[8], bounded[8], squared[8], z[8], x[8], y[8], slope[8], a[8], c[8], sr_[8], sy_[8], level_[8], widened_[8], high_[8], wide_[8];
        double largest[8];
        store(largest, max(max(p.scale[0], p.scale[1]), max(p.scale[2], abs(p.z))));
        store(level_, level), store(widened_, widened), store(high_, high), store(wide_, wide);
        store(finite, p.finite), store(bounded, footprint), store(squared, p.squared), store(z, p.z), store(x, p.x);
        store(y, p.y), store(slope, p.slope), store(a, p.a), store(c, p.c), store(sr_, sr), store(sy_, sy);
        for (int lane = 0; lane < kGroup && group + lane < end; lane++) {
            const int64_t i = group + lane;
            const double opacity = double(in.opacities[i]);
            double loose = finite[lane] + (opacity - opacity);
            for (int channel = 0; channel < 3; channel++) loose += double(in.colors[3 * i + channel]) - double(in.colors[3 * i + channel]);
            args.means2d[2 * i] = args.means2d[2 * i + 1] = args.radii[2 * i] = args.radii[2 * i + 1] = R(0);
            if (!(loose == 0 && largest[lane] <= s.far)) { args.status[i] = kNonFinite; continue; }
            if (!(squared[lane] >= 1e-24)) { args.status[i] = kZeroQuat; continue; }
            if (!(z[lane] > s.near)) { args.status[i] = kBehind; continue; }
            if (!(opacity > s.alpha_min)) { args.status[i] = kFaint; continue; }
            if (!(bounded[lane] == 0)) { args.status[i] = kNonFinite; continue; }
            double radius_x, radius_y;
            if (s.compat) {
                const double covariance = slope[lane] * c[lane], half = 0.5 * (a[lane] - c[lane]);
                const double largest = 0.5 * (a[lane] + c[lane]) + __builtin_sqrt(half * half + covariance * covariance);
                radius_x = radius_y = __builtin_ceil(3 * __builtin_sqrt(largest));
                if (__builtin_floor((x[lane] - radius_x) / kTile) >= __builtin_ceil(width / kTile) || __builtin_ceil((x[lane] + radius_x) / kTile) <= 0 ||
                    __builtin_floor((y[lane] - radius_y) / kTile) >= __builtin_ceil(height / kTile) || __builtin_ceil((y[lane] + radius_y) / kTile) <= 0 ||
                    radius_x == 0) { args.status[i] = kOutside; continue; }
            } else {
                const double reach = s.alpha_min > 0 ? 2 * kLn2 * level_[lane] : __builtin_inf();
                radius_x = __builtin_sqrt(reach * a[lane]), radius_y = __builtin_sqrt(reach * c[lane]);
                if (!(x[lane] - radius_x <= width + 0.5 && x[lane] + radius_x >= -0.5 && y[lane] - radius_y <= height + 0.5 &&
                      y[lane] + radius_y >= -0.5)) { args.status[i] = kOutside; continue; }
            }
            args.status[i] = kDrawn;
            args.depths[i] = z[lane];
            args.means2d[2 * i] = R(x[lane]), args.means2d[2 * i + 1] = R(y[lane]);
            args.radii[2 * i] = R(radius_x), args.radii[2 * i + 1] = R(radius_y);
            args.extents[2 * i] = wide_[lane], args.extents[2 * i + 1] = high_[lane];
            args.records[i] = {x[lane], y[lane], slope[lane], sr_[lane], sy_[lane], in.opacities[i], in.colors[3 * i],
                               in.colors[3 * i + 1], in.colors[3 * i + 2], R(z[lane]), R(widened_[lane])};
        }
    }
}

// Order of the sums per (tile, Gaussian); ge = dL/de, r and s the scaled distances.
enum Sum { kE, kR, kS, kRR, kRS, kSS, kRed, kGreen, kBlue, kDepth };

template <class R>
static void geometry_gradient(const GeometryGradientArgs<R>& args, int64_t begin, int64_t end) {
    const Camera& k = args.camera;
    const Inputs<R>& in = args.in;
    for (int64_t group = begin; group < end; group += kGroup) {
        double sums[kSums][kGroup] = {};
        double sr_[kGroup], sy_[kGroup], opacity[kGroup];
        bool drawn = false;
        for (int lane = 0; lane < kGroup; lane++) {
            const int64_t i = group + lane;
            sr_[lane] = sy_[lane] = opacity[lane] = 1;
            if (i >= end || args.status[i] != kDrawn) continue;
            drawn = true;
            sr_[lane] = args.records[i].sr, sy_[lane] = args.records[i].sy, opacity[lane] = double(in.opacities[i]);
            const R* slot = args.sums + int64_t(args.spans[i].begin) * kSlot;
            double total[kSums] = {};
            for (uint32_t pair = 0; pair < args.spans[i].count; pair++, slot += kSlot)
                for (int q = 0; q < kSums; q++) total[q] += double(slot[q]);
            for (int q = 0; q < kSums; q++) sums[q][lane] = total[q];
        }
        if (!drawn) {
            for (int64_t i = group; i < group + kGroup && i < end; i++) {
                for (int q = 0; q < 3; q++) args.v_means[3 * i + q] = args.v_log_scales[3 * i + q] = args.v_colors[3 * i + q] = R(0);
                for (int q = 0; q < 4; q++) args.v_quats[4 * i + q] = R(0);
                args.v_opacities[i] = R(0);
                if (args.v_offset) args.v_offset[2 * i] = args.v_offset[2 * i + 1] = R(0);
            }
            continue;
        }
        const Projected p = project_group(k, args.settings, in, group);
        const D sr = load<kGroup>(sr_), sy = load<kGroup>(sy_), ln2 = d8(kLn2);
        const D e = load<kGroup>(sums[kE]), e_r = load<kGroup>(sums[kR]) / (sr * p.v);
        const D g_x = -e_r;
        const D g_y = p.slope * e_r - load<kGroup>(sums[kS]) / (sy * p.c);
        const D g_slope = -(load<kGroup>(sums[kRS]) / (sr * sy * p.v));
        const D g_v = -(ln2 * load<kGroup>(sums[kRR]) / p.v);
        const D g_c = -(ln2 * load<kGroup>(sums[kSS]) / p.c);
        const D g_opacity = -(e / load<kGroup>(opacity));

        const D bent = g_slope / p.c, two = d8(2);
        D gn1[3], gn2[3], g_rho[3], g_affine[6];
        for (int j = 0; j < 3; j++) {
            const D t = p.m1[j] - p.slope * p.m2[j];
            const D g1 = two * g_v * t + bent * p.m2[j];
            const D g2 = bent * (t - p.slope * p.m2[j]) - two * p.slope * g_v * t + two * g_c * p.m2[j];
            g_rho[j] = two * (g_v * t * t + bent * t * p.m2[j] + g_c * p.m2[j] * p.m2[j]);
            gn1[j] = g1 * p.scale[j], gn2[j] = g2 * p.scale[j];
        }
        D V[9];  // gradient of the rotation
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) V[3 * i + j] = fma(p.affine[i], gn1[j], p.affine[3 + i] * gn2[j]);
        for (int i = 0; i < 3; i++) g_affine[i] = dot3(gn1, p.rotation + 3 * i), g_affine[3 + i] = dot3(gn2, p.rotation + 3 * i);
        const double* w2c = k.rotation;
        auto along = [&](const D* g, int row) { return fma(d8(w2c[3 * row]), g[0], fma(d8(w2c[3 * row + 1]), g[1], d8(w2c[3 * row + 2]) * g[2])); };
        const D j00 = along(g_affine, 0), j02 = along(g_affine, 2), j11 = along(g_affine + 3, 1), j12 = along(g_affine + 3, 2);

        const D fx = d8(k.fx), fy = d8(k.fy), iz = p.inverse_z, zero = d8(0);
        const D g_held_x = -(fx * iz * j02), g_held_y = -(fy * iz * j12);
        D g_z = -(iz * iz * (fx * j00 + fy * j11 - fx * p.held_x * j02 - fy * p.held_y * j12));
        // outside the limits the held ratio is a constant: no gradient through it
        const D free_x = select(p.held_x <= p.ratio_x, select(p.ratio_x <= p.held_x, g_held_x, zero), zero);
        const D free_y = select(p.held_y <= p.ratio_y, select(p.ratio_y <= p.held_y, g_held_y, zero), zero);
        const D to_x = free_x + fx * g_x, to_y = free_y + fy * g_y;
        const D camera[3] = {to_x * iz, to_y * iz, g_z - iz * (to_x * p.ratio_x + to_y * p.ratio_y) + load<kGroup>(sums[kDepth])};

        const D w = p.quat[0], a = p.quat[1], b = p.quat[2], d = p.quat[3];
        D q[4];
        q[0] = two * (a * (V[7] - V[5]) + b * (V[2] - V[6]) + d * (V[3] - V[1]));
        q[1] = two * (b * (V[3] + V[1]) + d * (V[2] + V[6]) + w * (V[7] - V[5]) - two * a * (V[4] + V[8]));
        q[2] = two * (a * (V[1] + V[3]) + d * (V[5] + V[7]) + w * (V[2] - V[6]) - two * b * (V[0] + V[8]));
        q[3] = two * (a * (V[2] + V[6]) + b * (V[5] + V[7]) + w * (V[3] - V[1]) - two * d * (V[0] + V[4]));
        const D radial = q[0] * w + q[1] * a + q[2] * b + q[3] * d;

        double out[16][kGroup];
        for (int i = 0; i < 3; i++) store(out[i], fma(d8(w2c[i]), camera[0], fma(d8(w2c[3 + i]), camera[1], d8(w2c[6 + i]) * camera[2])));
        for (int i = 0; i < 4; i++) store(out[3 + i], (q[i] - radial * p.quat[i]) * p.inverse_norm);
        for (int i = 0; i < 3; i++) store(out[7 + i], g_rho[i]);
        store(out[10], g_opacity), store(out[11], g_x), store(out[12], g_y);
        for (int lane = 0; lane < kGroup && group + lane < end; lane++) {
            const int64_t i = group + lane;
            const bool on = args.status[i] == kDrawn;  // what was not drawn has no gradient, whatever its lanes hold
            for (int q_ = 0; q_ < 3; q_++) {
                args.v_means[3 * i + q_] = on ? R(out[q_][lane]) : R(0);
                args.v_log_scales[3 * i + q_] = on ? R(out[7 + q_][lane]) : R(0);
                args.v_colors[3 * i + q_] = on ? R(sums[kRed + q_][lane]) : R(0);
            }
            for (int q_ = 0; q_ < 4; q_++) args.v_quats[4 * i + q_] = on ? R(out[3 + q_][lane]) : R(0);
            args.v_opacities[i] = on ? R(out[10][lane]) : R(0);
            if (args.v_offset) args.v_offset[2 * i] = on ? R(out[11][lane]) : R(0), args.v_offset[2 * i + 1] = on ? R(out[12][lane]) : R(0);
        }
    }
}

}  // namespace graings::GRAINGS_ISA
