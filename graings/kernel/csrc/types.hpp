// Plain data shared by all parts of the kernel. No code, no ownership: what is here has the same layout
// for every instruction set.
#pragma once
#include <cstddef>
#include <cstdint>

namespace graings {

constexpr int kTile = 16;    // edge of a tile in pixels
constexpr int kBlocks = 16;  // 4x4-pixel blocks per tile, row by row
constexpr int kLanes = 16;   // pixels per block, row by row
constexpr int kSums = 10;    // partial sums per (tile, Gaussian)

struct Camera {
    double rotation[9];  // world to camera, row by row
    double center[3];    // in the world
    double fx, fy, cx, cy;
    int64_t width, height;
};

struct Settings {
    double alpha_min, transmittance_min, alpha_max, blur, near, far, frustum_margin;
    bool compat;  // exclusive stop and the square of three standard deviations, as public rasterizers do
};

enum Status : uint8_t { kDrawn, kNonFinite, kZeroQuat, kBehind, kFaint, kOutside, kStatuses };

// One projected Gaussian: a cache line in single precision. With dx, dy = pixel - mean,
// alpha = opacity * 2^-((sr (dx - slope dy))^2 + (sy dy)^2); nothing is drawn where the exponent exceeds `level`.
// `flat` = 1 / sy and `fall` = 1 / ((sr slope)^2 + sy^2) only tell where that exponent is least.
template <class R>
struct Look {
    R sr, sy, opacity, red, green, blue, depth, level, flat, fall;
};
template <class R>
struct alignas(64) Record {
    double x, y, slope;
    Look<R> look;
};
static_assert(sizeof(Record<float>) == 64);

// The (tile, Gaussian) pairs of one Gaussian: where its sums begin and how many tiles it touches, of those in columns
// left..right and rows top..bottom.
struct Span {
    uint32_t begin, count, left, right, top, bottom;
    bool is_box() const { return count == (right - left + 1) * (bottom - top + 1); }
};

// A record seen from one tile. With a pixel's place in its block, r = base_r[block] + lanes[pixel] and
// s = base_s[block] + sy * row are the scaled distances; the bases are rounded from float64, where large numbers may
// cancel.
template <class R>
struct alignas(64) TileEntry {
    R lanes[kLanes], base_r[kBlocks], base_s[kBlocks];
    Look<R> look;
    R lean;  // sr slope
};

template <class R>
struct Inputs {
    int64_t count;
    const R *means, *quats, *log_scales, *opacities, *colors;
    const R* offset;  // [N, 2] px or null
    const R* background;
};

template <class R>
struct ProjectArgs {
    Camera camera;
    Settings settings;
    Inputs<R> in;
    Record<R>* records;
    uint8_t* status;
    double* depths;
    Span* spans;  // all but `begin`; the count is that of all tiles in the rectangle
    R *means2d, *radii;
};

// What the tile stage reads: entries of tile t are [begin[t], begin[t+1]), in depth order.
template <class R>
struct TileArgs {
    Camera camera;
    Settings settings;
    const R* background;
    const Record<R>* records;
    const int64_t* begin;
    const uint32_t* ids;
    uint16_t* masks;      // blocks of the tile that the entry may touch and that were still open
    int32_t* processed;   // entries per tile that were looked at before every pixel had stopped
    int32_t* items;       // (entry, block) pairs per tile
    R *light, *last;      // [tile, block, lane] for the gradient, or null: what passes all entries, and the number of
                          // the last entry of the tile that counted
    R *color, *alpha, *depth;
};

template <class R>
struct TileGradientArgs {
    TileArgs<R> tiles;
    const uint32_t* slots;             // where the sums of an entry go: contiguous per Gaussian, in tile order
    const R *v_color, *v_alpha, *v_depth;  // the last two may be null
    R* sums;                           // [slot, kSums]
    uint8_t* written;                  // [slot]: whether there are sums; there are none where all are 0
    double* v_background;              // [tile, 3] or null
};

template <class R>
struct GeometryGradientArgs {
    Camera camera;
    Settings settings;
    Inputs<R> in;
    const uint8_t* status;
    const Record<R>* records;
    const Span* spans;          // per Gaussian
    const R* sums;
    const uint8_t* written;
    R *v_means, *v_quats, *v_log_scales, *v_opacities, *v_colors, *v_offset;  // v_offset may be null
};

template <class R>
struct SsimArgs {
    int64_t height, width;
    int64_t row;    // numbers from one row of image, target and gradient to the next
    const R *image, *target;
    R* gradient;    // [height, width, 3] or null
    R* maps;        // three planes [height, width, 3]: what the gradient filters back
    double* sums;   // per band: of the similarity and of |image - target|
    R similarity, absolute;  // what each number counts in the gradient
};

constexpr int kMaxLayers = 16;
constexpr int64_t kNetworkRows = 64;  // rows at a time: their activations fit the second level of cache
constexpr int64_t kNetworkPad = 16;   // widths are padded to a multiple of this

// A network packed for the loops. Level 0 is the input, level `layers` the output.
template <class R>
struct NetworkArgs {
    int layers;
    int64_t widths[kMaxLayers + 1], padded[kMaxLayers + 1], widest;
    int64_t offsets[kMaxLayers + 2];  // of each level's activations in the scratch, then of two gradients
    int64_t weight_at[kMaxLayers], bias_at[kMaxLayers];  // in a set of partial sums
    const R* forward[kMaxLayers];   // [in, out]
    const R* backward[kMaxLayers];  // [out, in]; of the gradient only
    const R* biases[kMaxLayers];
    const R *input, *v_output;
    R *output, *v_input;  // v_input may be null
    const R* shared;        // [groups, widths[1]], added to the first layer of the rows of a group; or null
    const int64_t* groups;  // of each row, ascending
    R* v_shared;
    int64_t first_group_at;  // in a set of partial sums: the part of a group that began in the piece before
    R* hidden;            // the hidden levels of every block, kept for the gradient; null where none is wanted
};

// The functions compiled once per instruction set.
template <class R>
struct Kernels {
    void (*project)(const ProjectArgs<R>&, int64_t begin, int64_t end);
    void (*draw_tile)(const TileArgs<R>&, int64_t tile, TileEntry<R>* chunk);
    void (*tile_gradient)(const TileGradientArgs<R>&, int64_t tile);
    void (*geometry_gradient)(const GeometryGradientArgs<R>&, int64_t begin, int64_t end);
    void (*ssim_values)(const SsimArgs<R>&, int64_t band, int64_t begin, int64_t end, R* scratch);
    void (*ssim_gradient)(const SsimArgs<R>&, int64_t begin, int64_t end, R* scratch);
    void (*network_values)(const NetworkArgs<R>&, int64_t begin, int64_t end, R* scratch);
    void (*network_gradient)(const NetworkArgs<R>&, int64_t begin, int64_t end, R* sums, R* scratch);
};

constexpr int kChunk = 64;  // entries of a tile prepared at a time in the forward pass

}  // namespace graings
