// Tells every tile which Gaussians it draws, and in which order. They are counted and entered as they come, and sorted
// tile by tile, so that no thread walks what another one enters. Knows rectangles, depths and uids; nothing of pixels.
#pragma once
#include <algorithm>
#include <array>
#include <vector>
#include "buffer.hpp"
#include "pool.hpp"
#include "types.hpp"

namespace graings {

inline int64_t pieces_of(int64_t count, int64_t piece) { return (count + piece - 1) / piece; }

// Neighbours share Gaussians and lines of memory: a thread takes a run of tiles at a time, a short one where many threads
// would else wait for the last. visit(worker, tile, end of its run).
template <class Visit>
void each_tile(int threads, int64_t tiles, Visit visit) {
    const int64_t together = std::clamp<int64_t>(tiles / (16 * threads), 4, 16);
    parallel_for(threads, pieces_of(tiles, together), [&](int worker, int64_t piece) {
        const int64_t end = std::min(tiles, (piece + 1) * together);
        for (int64_t tile = piece * together; tile < end; tile++) visit(worker, tile, end);
    });
}

// A run of Gaussians, counted by one worker.
struct Piece {
    int64_t begin = 0, end = 0;
    int worker = 0;
    int64_t pairs = 0;
    uint64_t least = ~uint64_t(0), most = 0;  // of their depths, as bits
    std::array<int64_t, kStatuses> statuses{};
};

template <class R>
class Binning {
public:
    Binning(const Camera&, bool compat, int64_t gaussians, const Record<R>*, Span*, const double* depths, const int64_t* uids, int threads);

    // Counts the pairs of a piece whose begin, end and worker are known. A worker counts one piece at a time.
    void count(Piece&);

    // Enters the pairs of all pieces, tile by tile in no order.
    void enter(const std::vector<Piece>&);

    // Brings each tile's pairs in order of (depth, uid).
    void sort();

    int64_t count() const { return count_; }
    Buffer<Pair> pairs;
    Buffer<int64_t> begin;  // of each tile's pairs; one more at the end
    Buffer<uint32_t> places;  // of each Gaussian's pairs: where they begin; one more at the end

private:
    void enter(const Piece&, uint32_t first_place, uint32_t* next);
    void sort(Pair* pairs, int64_t count, std::vector<Pair>& half) const;
    uint32_t key(int64_t id) const;

    int64_t across_, tiles_, width_;
    bool compat_;
    const Record<R>* records_;
    Span* spans_;
    const double* depths_;
    const int64_t* uids_;
    int threads_;
    uint64_t least_ = ~uint64_t(0);
    int spare_bits_ = 0;                         // keys are left-aligned: their leading bits tell most
    std::vector<std::vector<uint32_t>> counts_;  // of each worker that counted, per tile
    int64_t count_ = 0;
};

}  // namespace graings
