// The loops of layers.hpp with weights and activations rounded to bfloat16 for every product; sums, biases and outputs are
// float32. Compiled for the tile registers of AMX (CMakeLists.txt).
#include "registers.hpp"
#include "types.hpp"

namespace graings {
namespace GRAINGS_ISA {
namespace {

using Args = NetworkArgs<float, Bfloat16>;
constexpr int64_t kRows = kNetworkRows, kStrip = 2 * kTileColumns;

// While it lives, this thread's eight tile registers have 16 rows of 64 bytes.
class Registers {
public:
    Registers() {
        struct alignas(64) {
            uint8_t palette = 1, start_row = 0, reserved[14] = {};
            uint16_t bytes_per_row[16] = {64, 64, 64, 64, 64, 64, 64, 64};
            uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
        } shape;
        _tile_loadconfig(&shape);
    }
    ~Registers() { _tile_release(); }
    Registers(const Registers&) = delete;
    Registers& operator=(const Registers&) = delete;
};

// c[kStrip, kStrip] = a b, or c + a b with `add`. Columns 16 to 31 of b follow b_column numbers after the others.
GRAINGS_INLINE void block(int64_t depth, const Bfloat16* a, int64_t a_row, const Bfloat16* b, int64_t b_column, float* c, int64_t c_row, bool add) {
    const int64_t a_bytes = 2 * a_row, c_bytes = 4 * c_row;
    if (add) {
        _tile_loadd(0, c, c_bytes);
        _tile_loadd(1, c + 16, c_bytes);
        _tile_loadd(2, c + 16 * c_row, c_bytes);
        _tile_loadd(3, c + 16 * c_row + 16, c_bytes);
    } else {
        _tile_zero(0);
        _tile_zero(1);
        _tile_zero(2);
        _tile_zero(3);
    }
    for (int64_t k = 0; k < depth; k += kTileDepth) {
        _tile_loadd(4, a + k, a_bytes);
        _tile_loadd(5, a + 16 * a_row + k, a_bytes);
        _tile_loadd(6, b + k * kTileColumns, 64);
        _tile_loadd(7, b + b_column + k * kTileColumns, 64);
        _tile_dpbf16ps(0, 4, 6);
        _tile_dpbf16ps(1, 4, 7);
        _tile_dpbf16ps(2, 5, 6);
        _tile_dpbf16ps(3, 5, 7);
    }
    _tile_stored(0, c, c_bytes);
    _tile_stored(1, c + 16, c_bytes);
    _tile_stored(2, c + 16 * c_row, c_bytes);
    _tile_stored(3, c + 16 * c_row + 16, c_bytes);
}

// c += a b for c [rows, columns]; all sizes are multiples of 32. Rows of `a` are a_row apart, `b` is in tiles.
GRAINGS_INLINE void add_product(int64_t rows, int64_t columns, int64_t depth, const Bfloat16* a, int64_t a_row, const Bfloat16* b, float* c) {
    const int64_t b_column = depth * kTileColumns;
    for (int64_t n = 0; n < columns; n += kStrip)
        for (int64_t m = 0; m < rows; m += kStrip) block(depth, a + m * a_row, a_row, b + n / kTileColumns * b_column, b_column, c + m * columns + n, columns, true);
}

// Calls each(n, c) for every strip c [rows, kStrip] of a b that begins at column n, while it is in the first-level cache.
template <class Each>
GRAINGS_INLINE void each_strip(int64_t rows, int64_t columns, int64_t depth, const Bfloat16* a, int64_t a_row, const Bfloat16* b, float* c, Each each) {
    const int64_t b_column = depth * kTileColumns;
    for (int64_t n = 0; n < columns; n += kStrip) {
        for (int64_t m = 0; m < rows; m += kStrip) block(depth, a + m * a_row, a_row, b + n / kTileColumns * b_column, b_column, c + m * kStrip, kStrip, false);
        each(n, c);
    }
}

// Mask of the numbers of a vector of 16 that are among `count`.
GRAINGS_INLINE __mmask16 first(int64_t count) { return count >= 16 ? __mmask16(0xFFFF) : count <= 0 ? __mmask16(0) : __mmask16((1u << count) - 1); }

// 32 numbers, rounded to nearest even; NaN stays NaN.
GRAINGS_INLINE void store_rounded(Bfloat16* to, __m512 low, __m512 high) { _mm512_storeu_si512(to, (__m512i)_mm512_cvtne2ps_pbh(high, low)); }

// Adds two vectors to the first numbers of `to`.
GRAINGS_INLINE void add(float* to, __mmask16 in_low, __m512 low, __mmask16 in_high, __m512 high) {
    _mm512_mask_storeu_ps(to, in_low, _mm512_add_ps(_mm512_maskz_loadu_ps(in_low, to), low));
    _mm512_mask_storeu_ps(to + 16, in_high, _mm512_add_ps(_mm512_maskz_loadu_ps(in_high, to + 16), high));
}

// kRows rows of `from` [., width], of which the first `rows` exist, to `to` [., padded]; the rest is zero.
GRAINGS_INLINE void round_rows(const float* from, int64_t rows, int64_t width, Bfloat16* to, int64_t padded) {
    for (int64_t c = 0; c < padded; c += kStrip) {
        const __mmask16 in_low = first(width - c), in_high = first(width - c - 16);
        for (int64_t r = 0; r < rows; r++) {
            const float* p = from + r * width + c;
            store_rounded(to + r * padded + c, _mm512_maskz_loadu_ps(in_low, p), _mm512_maskz_loadu_ps(in_high, p + 16));
        }
    }
    __builtin_memset(to + rows * padded, 0, sizeof(Bfloat16) * size_t((kRows - rows) * padded));
}

// Rows [., padded] of a block, to tiles of a matrix of depth kRows.
GRAINGS_INLINE void to_tiles(const Bfloat16* from, int64_t padded, Bfloat16* to) {
    alignas(64) static constexpr uint16_t low[32] = {0, 32, 1, 33, 2, 34, 3, 35, 4, 36, 5, 37, 6, 38, 7, 39, 8, 40, 9, 41, 10, 42, 11, 43, 12, 44, 13, 45, 14, 46, 15, 47};
    const __m512i left = _mm512_load_si512(low), right = _mm512_add_epi16(left, _mm512_set1_epi16(16));
    for (int64_t c = 0; c < padded; c += 32)
        for (int64_t r = 0; r < kRows; r += 2) {
            const __m512i even = _mm512_loadu_si512(from + r * padded + c), odd = _mm512_loadu_si512(from + (r + 1) * padded + c);
            Bfloat16* pairs = to + c * kRows + r * kTileColumns;
            _mm512_storeu_si512(pairs, _mm512_permutex2var_epi16(even, left, odd));
            _mm512_storeu_si512(pairs + kTileColumns * kRows, _mm512_permutex2var_epi16(even, right, odd));
        }
}

// Transposes a 16x16 matrix of 32-bit numbers in registers.
GRAINGS_INLINE void transpose(__m512i (&x)[16]) {
    __m512i y[16];
    for (int i = 0; i < 16; i += 2) y[i] = _mm512_unpacklo_epi32(x[i], x[i + 1]), y[i + 1] = _mm512_unpackhi_epi32(x[i], x[i + 1]);
    for (int i = 0; i < 16; i += 4)
        for (int j = 0; j < 2; j++) x[i + 2 * j] = _mm512_unpacklo_epi64(y[i + j], y[i + j + 2]), x[i + 2 * j + 1] = _mm512_unpackhi_epi64(y[i + j], y[i + j + 2]);
    for (int i = 0; i < 16; i += 8)
        for (int j = 0; j < 4; j++) y[i + j] = _mm512_shuffle_i32x4(x[i + j], x[i + j + 4], 0x88), y[i + j + 4] = _mm512_shuffle_i32x4(x[i + j], x[i + j + 4], 0xDD);
    for (int j = 0; j < 8; j++) x[j] = _mm512_shuffle_i32x4(y[j], y[j + 8], 0x88), x[j + 8] = _mm512_shuffle_i32x4(y[j], y[j + 8], 0xDD);
}

// Tiles of a matrix of depth kRows (to_tiles) to its transpose [padded, kRows].
GRAINGS_INLINE void transpose_tiles(const Bfloat16* tiles, int64_t padded, Bfloat16* to) {
    for (int64_t c = 0; c < padded; c += kTileColumns)
        for (int64_t r = 0; r < kRows; r += kTileDepth) {
            const Bfloat16* tile = tiles + c * kRows + r * kTileColumns;
            __m512i x[16];
            for (int i = 0; i < 16; i++) x[i] = _mm512_loadu_si512(tile + 32 * i);
            transpose(x);
            for (int i = 0; i < 16; i++) _mm512_storeu_si512(to + (c + i) * kRows + r, x[i]);
        }
}

// Memory of a worker. Levels 0 to layers - 1 of a block come first.
struct Scratch {
    Bfloat16* levels[kMaxLayers];
    Bfloat16 *above, *below, *tiles, *transposed;  // [kRows, widest]
    float* strip;                                  // [kRows, kStrip]

    Scratch(const Args& args, float* memory) {
        const int64_t block = args.widest * kRows;
        auto* at = reinterpret_cast<Bfloat16*>(memory);
        for (int l = 0; l < args.layers; l++) levels[l] = at + args.offsets[l];
        above = at + args.offsets[args.layers], below = above + block, tiles = below + block, transposed = tiles + block;
        strip = reinterpret_cast<float*>(transposed + block);
    }
    // Hidden levels of the block that begins at `row` are those that are kept, if any are.
    void place(const Args& args, int64_t row) {
        if (!args.hidden) return;
        Bfloat16* kept = args.hidden + row / kRows * (args.offsets[args.layers] - args.offsets[1]);
        for (int l = 1; l < args.layers; l++) levels[l] = kept + (args.offsets[l] - args.offsets[1]);
    }
};

// ReLU passes NaN.
void network_values(const Args& args, int64_t begin, int64_t end, float* memory) {
    const Registers registers;
    Scratch scratch(args, memory);
    const __m512 zero = _mm512_setzero_ps();
    for (int64_t row = begin; row < end; row += kRows) {
        const int64_t rows = end - row < kRows ? end - row : kRows;
        scratch.place(args, row);
        round_rows(args.input + row * args.widths[0], rows, args.widths[0], scratch.levels[0], args.padded[0]);
        for (int l = 0; l < args.layers; l++) {
            const int64_t in = args.padded[l], out = args.padded[l + 1], width = args.widths[l + 1];
            each_strip(kRows, out, in, scratch.levels[l], in, args.forward[l], scratch.strip, [&](int64_t n, float* sums) {
                const __m512 low = _mm512_loadu_ps(args.biases[l] + n), high = _mm512_loadu_ps(args.biases[l] + n + 16);
                const __mmask16 in_low = first(width - n), in_high = first(width - n - 16);
                if (l == 0 && args.shared)
                    for (int64_t r = 0; r < rows; r++) {
                        const float* common = args.shared + args.groups[row + r] * width + n;
                        add(sums + r * kStrip, 0xFFFF, _mm512_maskz_loadu_ps(in_low, common), 0xFFFF, _mm512_maskz_loadu_ps(in_high, common + 16));
                    }
                const auto sum = [&](int64_t r, int half) { return _mm512_add_ps(_mm512_loadu_ps(sums + r * kStrip + 16 * half), half ? high : low); };
                if (l + 1 < args.layers) {
                    Bfloat16* to = scratch.levels[l + 1] + n;
                    for (int64_t r = 0; r < kRows; r++) store_rounded(to + r * out, _mm512_max_ps(zero, sum(r, 0)), _mm512_max_ps(zero, sum(r, 1)));
                    return;
                }
                float* to = args.output + row * width + n;
                for (int64_t r = 0; r < rows; r++) _mm512_mask_storeu_ps(to + r * width, in_low, sum(r, 0)), _mm512_mask_storeu_ps(to + r * width + 16, in_high, sum(r, 1));
            });
        }
    }
}

void network_gradient(const Args& args, int64_t begin, int64_t end, float* sums, float* memory) {
    const Registers registers;
    Scratch scratch(args, memory);
    Bfloat16 *above = scratch.above, *below = scratch.below;
    const int64_t before = begin && args.groups ? args.groups[begin - 1] : -1;
    for (int64_t row = begin; row < end; row += kRows) {
        const int64_t rows = end - row < kRows ? end - row : kRows;
        scratch.place(args, row);
        round_rows(args.input + row * args.widths[0], rows, args.widths[0], scratch.levels[0], args.padded[0]);
        // Takes the gradient of kStrip outputs of layer l from column n on: numbers(r) are two vectors of row r.
        const auto take = [&](int l, int64_t n, Bfloat16* to, auto numbers) {
            const int64_t out = args.padded[l + 1], width = args.widths[l + 1];
            const __mmask16 in_low = first(width - n), in_high = first(width - n - 16);
            float* bias = sums + args.bias_at[l] + n;
            __m512 low = _mm512_loadu_ps(bias), high = _mm512_loadu_ps(bias + 16);
            for (int64_t r = 0; r < kRows; r++) {
                __m512 a, b;
                numbers(r, a, b);
                low = _mm512_add_ps(low, a), high = _mm512_add_ps(high, b);
                store_rounded(to + r * out + n, a, b);
            }
            for (int64_t r = 0; l == 0 && args.shared && r < rows; r++) {
                // Pieces run concurrently: the part of a group that began in an earlier piece is added later.
                const int64_t group = args.groups[row + r];
                __m512 a, b;
                numbers(r, a, b);
                add((group == before ? sums + args.first_group_at : args.v_shared + group * width) + n, in_low, a, in_high, b);
            }
            _mm512_storeu_ps(bias, low), _mm512_storeu_ps(bias + 16, high);
        };
        const int64_t last = args.widths[args.layers];
        for (int64_t n = 0; n < args.padded[args.layers]; n += kStrip)
            take(args.layers - 1, n, above, [&](int64_t r, __m512& a, __m512& b) {
                const float* from = args.v_output + (row + r) * last + n;
                const int64_t left = r < rows ? last - n : 0;
                a = _mm512_maskz_loadu_ps(first(left), from), b = _mm512_maskz_loadu_ps(first(left - 16), from + 16);
            });
        for (int l = args.layers - 1; l >= 0; l--) {
            const int64_t in = args.padded[l], out = args.padded[l + 1];
            to_tiles(above, out, scratch.tiles);
            transpose_tiles(scratch.tiles, out, scratch.transposed);
            to_tiles(scratch.levels[l], in, scratch.tiles);
            add_product(out, in, kRows, scratch.transposed, kRows, scratch.tiles, sums + args.weight_at[l]);
            if (l == 0 && !args.v_input) break;
            each_strip(kRows, in, out, above, out, args.backward[l], scratch.strip, [&](int64_t n, float* c) {
                if (l > 0) {
                    // A hidden unit at or below zero passes no gradient; one that is NaN does.
                    take(l - 1, n, below, [&](int64_t r, __m512& a, __m512& b) {
                        const __m512i units = _mm512_loadu_si512(scratch.levels[l] + r * in + n);
                        const auto passes = [](__m256i half) {
                            return _mm512_cmp_ps_mask((__m512)_mm512_slli_epi32(_mm512_cvtepu16_epi32(half), 16), _mm512_setzero_ps(), _CMP_NLE_UQ);
                        };
                        a = _mm512_maskz_loadu_ps(passes(_mm512_castsi512_si256(units)), c + r * kStrip);
                        b = _mm512_maskz_loadu_ps(passes(_mm512_extracti64x4_epi64(units, 1)), c + r * kStrip + 16);
                    });
                    return;
                }
                const int64_t width = args.widths[0];
                for (int64_t r = 0; r < rows; r++) {
                    float* to = args.v_input + (row + r) * width + n;
                    _mm512_mask_storeu_ps(to, first(width - n), _mm512_loadu_ps(c + r * kStrip));
                    _mm512_mask_storeu_ps(to + 16, first(width - n - 16), _mm512_loadu_ps(c + r * kStrip + 16));
                }
            });
            Bfloat16* done = above;
            above = below, below = done;
        }
    }
}

}  // namespace

extern const Bfloat16Kernels bfloat16;
const Bfloat16Kernels bfloat16{network_values, network_gradient};

}  // namespace GRAINGS_ISA
}  // namespace graings
