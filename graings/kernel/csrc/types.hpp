// Plain data shared by all parts of the kernel, with the same layout for every instruction set.
#pragma once
#include <cstddef>
#include <cstdint>

namespace graings {

constexpr int kTile = 16;    // edge of a tile in pixels
constexpr int kBlock = 4;    // edge of a block in pixels
constexpr int kBlocks = 16;  // per tile, row by row
constexpr int kLanes = 16;   // pixels per block, row by row
constexpr int kSums = 10;    // partial sums per (tile, Gaussian)
constexpr int kSumStride = 16;  // stride between the sums of two pairs: a cache line in single precision
constexpr int64_t kMaxImageSide = int64_t(kBlock) << 16;  // of an image: block indices have 16 bits

struct Camera {
    double rotation[9];  // world to camera, row by row
    double center[3];    // in the world
    double fx, fy, cx, cy;
    int64_t width, height;
};

struct Settings {
    double alpha_min, transmittance_min, alpha_max, blur, near, far, frustum_margin;
    bool compat;  // exclusive stop and square footprint of three standard deviations, as in public rasterizers
};

enum Status : uint8_t { kDrawn, kNonFinite, kZeroQuat, kBehind, kFaint, kOutside, kStatuses };

// One projected Gaussian: a cache line in single precision. With dx, dy = pixel - mean,
// alpha = 2^(log_opacity - q) with q = (sr (dx - slope dy))^2 + (sy dy)^2; nothing is drawn where q exceeds `level`.
// Logarithms are of base 2.
template <class R>
struct SplatParameters {
    R sr, sy, log_opacity, red, green, blue, depth, level;
};
template <class R>
struct alignas(64) Record {
    double x, y, slope;
    SplatParameters<R> params;
};
static_assert(sizeof(Record<float>) == 64);

// The rectangle of blocks that a Gaussian may touch, counted from the image's top left, and its number of tiles.
struct Span {
    uint32_t count;
    uint16_t left, right, top, bottom;
    static constexpr int kPerTile = kTile / kBlock;
    uint32_t first_column() const { return left / kPerTile; }
    uint32_t last_column() const { return right / kPerTile; }
    uint32_t first_row() const { return top / kPerTile; }
    uint32_t last_row() const { return bottom / kPerTile; }
    uint32_t tiles() const { return (last_column() - first_column() + 1) * (last_row() - first_row() + 1); }
    bool is_box() const { return count == tiles(); }
};

// A Gaussian on a tile.
struct Pair {
    uint32_t key;    // leading bits of the depth; after drawing, the number of the entry in its tile
    uint32_t id;
    uint32_t place;  // its slot: its number among all pairs in the order of the Gaussians
    uint32_t mask;   // blocks of the tile that it may touch, one bit each
};

// Of 64 slots: which are taken, and how many taken slots precede them.
struct Ranks {
    uint64_t taken;
    uint32_t before;
};

// A record relative to one tile. The scaled distances of a pixel are r = r[block] + lanes[pixel] and
// s = s[block] + sy * row. Those of the block centres are computed in float64, because large numbers cancel.
template <class R>
struct alignas(64) TileEntry {
    R lanes[kLanes], r[kBlocks], s[kBlocks];
    SplatParameters<R> params;
    R tilt;    // sr * slope
    R number;  // of the entry in its tile
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
    Span* spans;  // with the number of tiles of the rectangle as count
    R *means2d, *radii;
};

// Arguments of the tile stage: entries of tile t are [begin[t], begin[t+1]), in depth order.
template <class R>
struct TileArgs {
    Camera camera;
    Settings settings;
    const R* background;
    const Record<R>* records;
    const int64_t* begin;
    Pair* pairs;          // for the gradient, drawn pairs move to the front of a tile's list, with their number as key
    int32_t* kept;        // drawn entries per tile, that is those that some unfinished block has evaluated
    int32_t* items;       // (entry, block) pairs per tile
    uint8_t* shown;       // [slot] for the gradient, or null: whether a block has drawn the pair; initially 0
    R *light, *last;      // [tile, block, lane] for the gradient, or null: final transmittance, and the number of the
                          // last entry of the tile that contributed
    R *color, *alpha, *depth;  // depth may be null
};

template <class R>
struct TileGradientArgs {
    TileArgs<R> tiles;
    const R *v_color, *v_alpha, *v_depth;  // the last two may be null
    const Ranks* ranks;                // of the slots of drawn pairs
    R* sums;                           // [rank, kSums]
    double* v_background;              // [tile, 3] or null
};

template <class R>
struct GeometryGradientArgs {
    Camera camera;
    Settings settings;
    Inputs<R> in;
    const uint8_t* status;
    const uint32_t* places;     // slot of each Gaussian's first pair, and the end of the last
    const Ranks* ranks;         // of the slots of drawn pairs
    const R* sums;
    R *v_means, *v_quats, *v_log_scales, *v_opacities, *v_colors, *v_offset;  // v_offset may be null
};

// SSIM as 3D Gaussian Splatting defines it; graings/constants.py holds the same numbers, and a test compares the two.
// Compiled in, because the loops over the window are unrolled.
constexpr int kSsimRadius = 5;  // of the window, in pixels
constexpr double kSsimC1 = 0.01 * 0.01, kSsimC2 = 0.03 * 0.03;
// exp(-k^2 / (2 sigma^2)) for k = 0..5 with sigma 1.5, normalised over the 11 taps.
constexpr double kSsimTaps[kSsimRadius + 1] = {0.2660117248617943,   0.21300553771125366,  0.1093606895097,
                                               0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};

struct Range { int64_t begin, end; };  // [begin, end)

template <class R>
struct SsimArgs {
    int64_t height, width;
    int64_t row;    // row stride of image, target and gradient, in numbers
    const R *image, *target;
    const Range* windows;  // of each row, the numbers whose window contains a difference: elsewhere SSIM is 1
    const Range* affected;   // and those inside such a window: elsewhere the gradient is 0, and is not written
    R* gradient;    // [height, width, 3] or null
    R* maps;        // three planes [height, width, 3], which the gradient filters
    double* sums;   // per band: sums of SSIM, of |image - target| and of its square
    R similarity, absolute, squared;  // weight of each number in the gradient
};

constexpr int kMaxLayers = 16;
constexpr int64_t kNetworkRows = 64;  // rows per block: their activations fit into the second-level cache
constexpr int64_t kNetworkPad = 16;   // widths are padded to a multiple of this
constexpr int64_t kPanel = 32;        // weights are stored in panels of this many columns, row by row

// Upper half of a float32. Products of such numbers are exact in float32, in which they are summed.
enum Bfloat16 : uint16_t {};

// Networks in bfloat16: weights are stored in tiles of kTileColumns columns and kTileDepth rows, of which two at a time are
// interleaved, as the instructions take them. Widths are padded to a multiple of kTileDepth.
constexpr int64_t kTileColumns = 16, kTileDepth = 32;

// A network packed for the loops. Level 0 is the input, level `layers` the output. Weights and hidden levels are stored as
// `Stored`.
template <class R, class Stored = R>
struct NetworkArgs {
    int layers;
    int64_t widths[kMaxLayers + 1], padded[kMaxLayers + 1], widest;
    int64_t offsets[kMaxLayers + 2];  // of each level's activations in the scratch memory, then of what follows them
    int64_t weight_at[kMaxLayers], bias_at[kMaxLayers];  // offsets in a set of partial sums
    const Stored* forward[kMaxLayers];   // [in, out], in panels or tiles
    const Stored* backward[kMaxLayers];  // [out, in], in panels or tiles; only for the gradient
    const R* biases[kMaxLayers];
    const R *input, *v_output;
    R *output, *v_input;  // v_input may be null
    const R* shared;        // [groups, widths[1]], added to the first layer of the rows of a group; or null
    const int64_t* groups;  // of each row, ascending
    R* v_shared;
    int64_t first_group_at;  // offset in a set of partial sums: the part of a group that began in an earlier piece
    Stored* hidden;       // the hidden levels of every block, kept for the gradient; may be null
};

constexpr int kMoving = 16;    // children per block of the arrays of MoveArgs
constexpr int kOffsets = 10;   // outputs of DeformNet: position 3, rotation 4, log-scale 3
constexpr int kBlended = 4;    // values of BlendArgs: colour 3, opacity
enum Activation : int { kSigmoid, kTanh };

// Children whose offsets in time are weights [width, kOffsets] times hidden units plus `bias`, in blocks of kMoving
// children. A unit that is zero in a whole block is left out. Rows of `hidden` and `rest` hold a number for each child of
// a block: those of block b are begin[b] to begin[b + 1], of the units `units`; in `rest` mean 3, quaternion 4, log-scale 3.
template <class R>
struct MoveArgs {
    const R* hidden;  // [units of all blocks, kMoving]
    const int64_t* begin;
    const int32_t* units;
    const R *rest, *weights, *bias;  // rest: [blocks, kOffsets, kMoving]
    R extent, change, low, high;     // of the scene; bounds of log-scales
    const int64_t* rows;             // children to move
    R *mean, *quat, *log_scale;      // in the order of `rows`
};

// Values of children that are `state` plus weights times `functions` [rank, kBlended], in blocks as in MoveArgs: rows of
// `weights` hold a number for each child of a block, those of block b are begin[b] to begin[b + 1], of the functions `units`.
template <class R>
struct BlendArgs {
    const R* weights;  // [weights of all blocks, kMoving]
    const int64_t* begin;
    const int32_t* units;
    const R *state, *functions;  // state: [blocks, kBlended, kMoving]
    R* out;                      // [blocks, kMoving, kBlended]
};

// The functions compiled once per instruction set.
template <class R>
struct Kernels {
    void (*project)(const ProjectArgs<R>&, int64_t begin, int64_t end);
    void (*draw_tile)(const TileArgs<R>&, int64_t tile, int64_t next_end, TileEntry<R>* chunk);  // the same thread draws the tiles before next_end
    void (*tile_gradient)(const TileGradientArgs<R>&, int64_t tile);
    void (*geometry_gradient)(const GeometryGradientArgs<R>&, int64_t begin, int64_t end);
    void (*ssim_values)(const SsimArgs<R>&, int64_t band, int64_t begin, int64_t end, R* scratch);
    void (*ssim_gradient)(const SsimArgs<R>&, int64_t begin, int64_t end, R* scratch);
    void (*network_values)(const NetworkArgs<R>&, int64_t begin, int64_t end, R* scratch);
    void (*network_gradient)(const NetworkArgs<R>&, int64_t begin, int64_t end, R* sums, R* scratch);
    void (*activate)(Activation, int64_t count, const R* x, R* out);
    void (*activate_gradient)(Activation, int64_t count, const R* x, const R* v, R* out);
    void (*finish_colors)(int64_t count, R bound, const R* residual, R* colors);  // residual may be null
    void (*move_children)(const MoveArgs<R>&, int64_t begin, int64_t end);
    void (*blend_children)(const BlendArgs<R>&, int64_t begin, int64_t end);  // blocks
};

// Networks whose weights and activations are rounded to bfloat16 for every product, compiled for AMX.
struct Bfloat16Kernels {
    void (*network_values)(const NetworkArgs<float, Bfloat16>&, int64_t begin, int64_t end, float* scratch);
    void (*network_gradient)(const NetworkArgs<float, Bfloat16>&, int64_t begin, int64_t end, float* sums, float* scratch);
};

constexpr int kChunk = 64;  // entries of a tile prepared at a time in the forward pass

}  // namespace graings
