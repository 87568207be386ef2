// Projection of Gaussians to records and its adjoint: always in float64, eight Gaussians at a time.
// The footprint is stored as a shear; its determinant is computed without a subtraction.
#pragma once
#include "exponentials.hpp"
#include "ranks.hpp"
#include "records.hpp"
#include "types.hpp"

namespace graings::GRAINGS_ISA {

GRAINGS_INLINE D d8(double x) { return splat<double, kGroup>(x); }

constexpr double kRootHalfLog2E = 0.8493218002880191;  // sqrt(log2(e) / 2)
constexpr double kLn2 = 0.6931471805599453;
constexpr double kLog2E = 1.4426950408889634;

// Quantities of eight Gaussians that both passes need.
struct Projected {
    D z, inverse_z, ratio_x, ratio_y, clamped_x, clamped_y;  // held: clamped before the Jacobian
    D quat[4], squared, inverse_squared;
    D rotation[9], scale[3];
    D affine[6];      // Jacobian times world-to-camera rotation, 2x3
    D m1[3], m2[3];   // rows of the factor of the covariance
    D x, y, slope, v, c, inverse_c, a;
    D finite;         // 0 if all inputs are finite, else NaN
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

template <class R>
GRAINGS_INLINE Projected project_group(const Camera& k, const Settings& settings, const Limits& limit, const Inputs<R>& in, int64_t begin) {
    Projected p;
    D mean[3], rho[3], offset[2];
    columns_of<3>(in.means, begin, in.count, mean);
    columns_of<3>(in.log_scales, begin, in.count, rho);
    columns_of<4>(in.quats, begin, in.count, p.quat);
    offset[0] = offset[1] = d8(0);
    if (in.offset) columns_of<2>(in.offset, begin, in.count, offset);
    p.finite = d8(0);
    for (int i = 0; i < 3; i++) p.finite = p.finite + (mean[i] - mean[i]) + (rho[i] - rho[i]);
    for (int i = 0; i < 2; i++) p.finite = p.finite + (offset[i] - offset[i]);

    // the difference comes before the rotation, to avoid cancellation far from the world's origin
    D away[3], camera[3];
    for (int i = 0; i < 3; i++) away[i] = mean[i] - d8(k.center[i]);
    for (int i = 0; i < 3; i++)
        camera[i] = fma(d8(k.rotation[3 * i]), away[0], fma(d8(k.rotation[3 * i + 1]), away[1], d8(k.rotation[3 * i + 2]) * away[2]));
    p.z = camera[2];
    p.inverse_z = d8(1) / p.z;
    p.ratio_x = camera[0] * p.inverse_z;
    p.ratio_y = camera[1] * p.inverse_z;
    p.clamped_x = clamp(p.ratio_x, limit.low_x, limit.high_x);
    p.clamped_y = clamp(p.ratio_y, limit.low_y, limit.high_y);

    p.squared = fma(p.quat[0], p.quat[0], fma(p.quat[1], p.quat[1], fma(p.quat[2], p.quat[2], p.quat[3] * p.quat[3])));
    p.finite = p.finite + (p.squared - p.squared);
    p.inverse_squared = d8(1) / p.squared;
    const D w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3], one = d8(1), two = d8(2) * p.inverse_squared;
    D* r = p.rotation;
    r[0] = one - two * fma(y, y, z * z), r[1] = two * (x * y - w * z), r[2] = two * fma(x, z, w * y);
    r[3] = two * fma(x, y, w * z), r[4] = one - two * fma(x, x, z * z), r[5] = two * (y * z - w * x);
    r[6] = two * (x * z - w * y), r[7] = two * fma(y, z, w * x), r[8] = one - two * fma(x, x, y * y);
    for (int i = 0; i < 3; i++) p.scale[i] = exp<R>(rho[i]);

    const D fx = d8(k.fx) * p.inverse_z, fy = d8(k.fy) * p.inverse_z;
    for (int i = 0; i < 3; i++) {
        const D forward = d8(k.rotation[6 + i]);
        p.affine[i] = fx * (d8(k.rotation[i]) - p.clamped_x * forward);
        p.affine[3 + i] = fy * (d8(k.rotation[3 + i]) - p.clamped_y * forward);
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
    p.inverse_c = d8(1) / p.c;
    p.slope = xy * p.inverse_c;
    p.v = determinant * p.inverse_c;
    p.x = fma(d8(k.fx), p.ratio_x, d8(k.cx)) + offset[0];
    p.y = fma(d8(k.fy), p.ratio_y, d8(k.cy)) + offset[1];
    return p;
}

template <class R>
static void project(const ProjectArgs<R>& given, int64_t begin, int64_t end) {
    const ProjectArgs<R> args = given;  // a copy, because the compiler assumes that storing bytes to `status` may change `given`
    // Vectors are not const here: GCC 12 keeps const vectors of two registers in memory.
    const Settings& s = args.settings;
    const Inputs<R>& in = args.in;
    Limits limit = limits(args.camera, s);
    const double width = double(args.camera.width), height = double(args.camera.height);
    D half = d8(0.5), zero = d8(0), one = d8(1), w = d8(width), h = d8(height), faintest = d8(__builtin_log2(s.alpha_min)), slack = d8(1e-5) - d8(1e-6) * faintest;
    for (int64_t group = begin; group < end; group += kGroup) {
        D opacity, color[3];
        columns_of<1>(in.opacities, group, in.count, &opacity);
        columns_of<3>(in.colors, group, in.count, color);
        // early, because this dependency chain overlaps with that of the projection
        D log_opacity = log2<R>(opacity), level = s.alpha_min > 0 ? log_opacity - faintest : d8(1e30), root = sqrt(max(level, zero));
        Projected p = project_group(args.camera, s, limit, in, group);
        D footprint = (p.x - p.x) + (p.y - p.y) + (p.slope - p.slope) + (p.v - p.v) + (p.c - p.c) + (p.a - p.a);
        D inputs_finite = p.finite + (opacity - opacity) + (color[0] - color[0]) + (color[1] - color[1]) + (color[2] - color[2]);
        D std_x = sqrt(p.a), std_y = sqrt(p.c), std_x_given_y = sqrt(p.v), unit = d8(kRootHalfLog2E), radius = d8(1 / kRootHalfLog2E);
        D sr = unit * std_x_given_y / p.v, sy = unit * std_y * p.inverse_c;  // unit / sqrt(v), unit / sqrt(c)
        // Nothing is drawn where q exceeds `level`. The exact test is done per pixel; bounds derived here only save work, so
        // they are widened by more than the rounding error of the exponent, whose magnitude is `faintest` there.
        D widened = min(fma(level, d8(1 + 1e-5), slack), d8(1e30));
        D reach = fma(root, d8(1 + 1e-5), d8(4e-3)) * radius, wide = reach * std_x, high = reach * std_y;  // half-widths of the footprint
        // first and last pixels whose centres are inside, and their blocks
        const auto block = [](D pixel) { return floor(pixel * d8(1.0 / kBlock)); };
        D first_x = zero - floor(zero - clamp(p.x - wide - half, zero, w)), last_x = floor(clamp(p.x + wide - half, zero - one, w - one));
        D first_y = zero - floor(zero - clamp(p.y - high - half, zero, h)), last_y = floor(clamp(p.y + high - half, zero - one, h - one));
        D exact = (s.alpha_min > 0 ? root : d8(__builtin_inf())) * radius;
        D radii[2] = {exact * std_x, exact * std_y};
        D sides[4] = {block(first_x), block(last_x), block(first_y), block(last_y)};
        auto tiled = (first_x <= last_x) & (first_y <= last_y), inside = zero <= zero;
        if (s.compat) {
            double x[kGroup], y[kGroup], a[kGroup], c[kGroup], slope[kGroup], square[kGroup], hit[kGroup], box[4][kGroup];
            store(x, p.x), store(y, p.y), store(a, p.a), store(c, p.c), store(slope, p.slope);
            for (int i = 0; i < kGroup; i++) {
                const double covariance = slope[i] * c[i], difference = 0.5 * (a[i] - c[i]);
                square[i] = __builtin_ceil(3 * __builtin_sqrt(0.5 * (a[i] + c[i]) + __builtin_sqrt(difference * difference + covariance * covariance)));
                const auto bound = [](double t, double most) { return !(t > 0) ? 0 : t > most ? most : t; };
                const double across = __builtin_ceil(width / kTile), down = __builtin_ceil(height / kTile);
                box[0][i] = bound(__builtin_floor((x[i] - square[i]) / kTile), across), box[1][i] = bound(__builtin_ceil((x[i] + square[i]) / kTile), across) - 1;
                box[2][i] = bound(__builtin_floor((y[i] - square[i]) / kTile), down), box[3][i] = bound(__builtin_ceil((y[i] + square[i]) / kTile), down) - 1;
                hit[i] = square[i] > 0 && box[0][i] <= box[1][i] && box[2][i] <= box[3][i];
                for (int side = 0; side < 4; side++) box[side][i] = Span::kPerTile * box[side][i] + side % 2 * (Span::kPerTile - 1);  // compat uses whole tiles
            }
            for (int side = 0; side < 4; side++) sides[side] = load<kGroup>(box[side]);
            radii[0] = radii[1] = load<kGroup>(square);
            tiled = inside = zero < load<kGroup>(hit);
        } else
            inside = (p.x - radii[0] <= w + half) & (zero - half <= p.x + radii[0]) & (p.y - radii[1] <= h + half) & (zero - half <= p.y + radii[1]);

        const auto is_zero = [&](D t) { return (zero <= t) & (t <= zero); };  // false for NaN
        D largest = max(max(p.scale[0], p.scale[1]), max(p.scale[2], abs(p.z)));
        auto finite = is_zero(inputs_finite) & (largest <= d8(s.far)), has_direction = d8(1e-24) <= p.squared, in_front = d8(s.near) < p.z;
        auto seen = d8(s.alpha_min) < opacity, bounded = is_zero(footprint);
        auto drawn = finite & has_direction & in_front & seen & bounded & inside;
        D center[2] = {select(drawn, p.x, zero), select(drawn, p.y, zero)};
        radii[0] = select(drawn, radii[0], zero), radii[1] = select(drawn, radii[1], zero);
        store_columns<2>(args.means2d, group, end, center), store_columns<2>(args.radii, group, end, radii);
        store_columns<1>(args.depths, group, end, &p.z);
        D whole[3] = {p.x, p.y, p.slope}, pairs[4][2] = {{sr, sy}, {log_opacity, color[0]}, {color[1], color[2]}, {p.z, widened}};
        put_records(args.records, group, end, whole, pairs);
        const auto tile = [](D block) { return floor(block * d8(1.0 / Span::kPerTile)); };
        D tiles = (tile(sides[1]) - tile(sides[0]) + one) * (tile(sides[3]) - tile(sides[2]) + one);
        auto on_tiles = drawn & tiled;
        for (D& side : sides) side = select(on_tiles, side, zero);
        put_spans(args.spans, group, end, select(on_tiles, tiles, zero), sides);
        D status = d8(kOutside);  // assigned from the last to the first reason
        status = select(bounded, status, d8(kNonFinite)), status = select(seen, status, d8(kFaint)), status = select(in_front, status, d8(kBehind));
        status = select(has_direction, status, d8(kZeroQuat)), status = select(finite, status, d8(kNonFinite)), status = select(drawn, d8(kDrawn), status);
        put_bytes(args.status, group, end, status);
    }
}

// Order of the partial sums per pair. E: -dL/de of the exponent e; R, S, RR, RS, SS: E times products of r and s.
enum Sum { kE, kR, kS, kRR, kRS, kSS, kRed, kGreen, kBlue, kDepth };

constexpr int kSumsAhead = 16;  // prefetch distance

template <class R>
static void geometry_gradient(const GeometryGradientArgs<R>& args, int64_t begin, int64_t end) {
    const Camera& k = args.camera;
    const Inputs<R>& in = args.in;
    const Limits limit = limits(k, args.settings);
    for (int64_t group = begin; group < end; group += kGroup) {
        alignas(64) double sums[kGroup][kSumStride];
        double on_[kGroup];
        bool drawn = false;
        uint32_t first = rank(args.ranks, args.places[group]);  // rank of the first Gaussian's first pair
        for (int lane = 0; lane < kGroup; lane++) {
            const int64_t i = group + lane < end ? group + lane : end - 1;
            const bool own = group + lane < end && args.status[i] == kDrawn;
            on_[lane] = own, drawn |= own;
            const uint32_t next = own ? rank(args.ranks, args.places[i + 1]) : first, count = next - first;
            Sums total{d8(0), d8(0)};
            const auto add = [&](uint32_t at, bool there) {
                const R* of_pair = args.sums + int64_t(at) * kSumStride;
                __builtin_prefetch(of_pair + kSumsAhead * kSumStride);
                add_sums(of_pair, there, total);
            };
            add(first, count > 0), add(first + (count > 1), count > 1);  // most Gaussians have at most two; no branch
            for (uint32_t at = first + 2; at < next; at++) add(at, true);
            first = next;
            store(sums[lane], total.first), store(sums[lane] + kGroup, total.rest);
        }
        const D none[4] = {d8(0), d8(0), d8(0), d8(0)};
        const auto put = [&](const D* means, const D* quats, const D* log_scales, const D* opacity, const D* colors, const D* offset) {
            store_columns<3>(args.v_means, group, end, means), store_columns<4>(args.v_quats, group, end, quats);
            store_columns<3>(args.v_log_scales, group, end, log_scales), store_columns<1>(args.v_opacities, group, end, opacity);
            store_columns<3>(args.v_colors, group, end, colors);
            if (args.v_offset) store_columns<2>(args.v_offset, group, end, offset);
        };
        if (!drawn) {
            put(none, none, none, none, none, none);
            continue;
        }
        const Projected p = project_group(k, args.settings, limit, in, group);
        D total[kSums];
        columns_of_sums(sums, total);
        const D ln2 = d8(kLn2), inverse_v = d8(1) / p.v, inverse_sr = d8(1 / kRootHalfLog2E) * sqrt(p.v), inverse_sy = d8(1 / kRootHalfLog2E) * sqrt(p.c);
        const D across = inverse_sr * inverse_v, g_x = total[kR] * across;
        const D g_y = total[kS] * inverse_sy * p.inverse_c - p.slope * g_x;
        const D g_slope = total[kRS] * inverse_sy * across;
        const D g_v = ln2 * total[kRR] * inverse_v;
        const D g_c = ln2 * total[kSS] * p.inverse_c;
        D opacity;
        columns_of<1>(in.opacities, group, in.count, &opacity);
        const D g_opacity = total[kE] / opacity;

        const D g_slope_c = g_slope * p.inverse_c, two = d8(2);
        D gn1[3], gn2[3], g_rho[3], g_affine[6];
        for (int j = 0; j < 3; j++) {
            const D t = p.m1[j] - p.slope * p.m2[j];
            const D g1 = two * g_v * t + g_slope_c * p.m2[j];
            const D g2 = g_slope_c * (t - p.slope * p.m2[j]) - two * p.slope * g_v * t + two * g_c * p.m2[j];
            g_rho[j] = two * (g_v * t * t + g_slope_c * t * p.m2[j] + g_c * p.m2[j] * p.m2[j]);
            gn1[j] = g1 * p.scale[j], gn2[j] = g2 * p.scale[j];
        }
        D V[9];  // gradient with respect to the rotation
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) V[3 * i + j] = fma(p.affine[i], gn1[j], p.affine[3 + i] * gn2[j]);
        for (int i = 0; i < 3; i++) g_affine[i] = dot3(gn1, p.rotation + 3 * i), g_affine[3 + i] = dot3(gn2, p.rotation + 3 * i);
        const double* w2c = k.rotation;
        auto along = [&](const D* g, int row) { return fma(d8(w2c[3 * row]), g[0], fma(d8(w2c[3 * row + 1]), g[1], d8(w2c[3 * row + 2]) * g[2])); };
        const D j00 = along(g_affine, 0), j02 = along(g_affine, 2), j11 = along(g_affine + 3, 1), j12 = along(g_affine + 3, 2);

        const D fx = d8(k.fx), fy = d8(k.fy), iz = p.inverse_z, zero = d8(0);
        const D g_clamped_x = -(fx * iz * j02), g_clamped_y = -(fy * iz * j12);
        D g_z = -(iz * iz * (fx * j00 + fy * j11 - fx * p.clamped_x * j02 - fy * p.clamped_y * j12));
        // outside the limits the clamped ratio is constant and passes no gradient
        const D free_x = select(p.clamped_x <= p.ratio_x, select(p.ratio_x <= p.clamped_x, g_clamped_x, zero), zero);
        const D free_y = select(p.clamped_y <= p.ratio_y, select(p.ratio_y <= p.clamped_y, g_clamped_y, zero), zero);
        const D to_x = free_x + fx * g_x, to_y = free_y + fy * g_y;
        const D camera[3] = {to_x * iz, to_y * iz, g_z - iz * (to_x * p.ratio_x + to_y * p.ratio_y) + total[kDepth]};

        const D w = p.quat[0], a = p.quat[1], b = p.quat[2], d = p.quat[3];
        D q[4];
        q[0] = two * (a * (V[7] - V[5]) + b * (V[2] - V[6]) + d * (V[3] - V[1]));
        q[1] = two * (b * (V[3] + V[1]) + d * (V[2] + V[6]) + w * (V[7] - V[5]) - two * a * (V[4] + V[8]));
        q[2] = two * (a * (V[1] + V[3]) + d * (V[5] + V[7]) + w * (V[2] - V[6]) - two * b * (V[0] + V[8]));
        q[3] = two * (a * (V[2] + V[6]) + b * (V[5] + V[7]) + w * (V[3] - V[1]) - two * d * (V[0] + V[4]));
        const D radial = (q[0] * w + q[1] * a + q[2] * b + q[3] * d) * p.inverse_squared;

        // lanes of Gaussians that were not drawn may hold anything; their gradient is 0
        const auto on = zero < load<kGroup>(on_);
        const auto kept = [&](D x) { return select(on, x, zero); };
        D means[3], quats[4], log_scales[3], colors[3];
        for (int i = 0; i < 3; i++) {
            means[i] = kept(fma(d8(w2c[i]), camera[0], fma(d8(w2c[3 + i]), camera[1], d8(w2c[6 + i]) * camera[2])));
            log_scales[i] = kept(g_rho[i]), colors[i] = kept(total[kRed + i]);
        }
        for (int i = 0; i < 4; i++) quats[i] = kept((q[i] - radial * p.quat[i]) * p.inverse_squared);
        opacity = kept(g_opacity);
        const D offset[2] = {kept(g_x), kept(g_y)};
        put(means, quats, log_scales, &opacity, colors, offset);
    }
}

}  // namespace graings::GRAINGS_ISA
