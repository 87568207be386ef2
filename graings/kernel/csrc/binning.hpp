// The list of Gaussians of every tile, in depth order. Pairs of tile and Gaussian are counted, entered in the order of the
// Gaussians, and sorted tile by tile, so that no thread reads what another one is writing.
#pragma once
#include <algorithm>
#include <array>
#include <vector>
#include "buffer.hpp"
#include "pool.hpp"
#include "types.hpp"

namespace graings {

inline int64_t pieces_of(int64_t count, int64_t piece) { return (count + piece - 1) / piece; }

// Calls visit(worker, tile, end of the worker's run of tiles). Adjacent tiles share Gaussians and cache lines, so a worker
// takes a run of tiles at a time; with many threads a short one, to balance the load at the end.
template <class Visit>
void each_tile(int threads, int64_t tiles, Visit visit) {
    const int64_t together = std::clamp<int64_t>(tiles / (16 * threads), 4, 16);
    parallel_for(threads, pieces_of(tiles, together), [&](int worker, int64_t piece) {
        const int64_t end = std::min(tiles, (piece + 1) * together);
        for (int64_t tile = piece * together; tile < end; tile++) visit(worker, tile, end);
    });
}

// A range of Gaussians, counted by one worker.
struct Piece {
    int64_t begin = 0, end = 0;
    int worker = 0;
    int64_t pairs = 0;
    uint64_t least = ~uint64_t(0), most = 0;  // smallest and largest depth, as bit patterns
    std::array<int64_t, kStatuses> statuses{};
};

template <class R>
class Binning {
public:
    Binning(const Camera&, bool compat, int64_t gaussians, const Record<R>*, Span*, const double* depths, const int64_t* uids, int threads);

    // Counts the pairs of a piece whose begin, end and worker are set. A worker counts one piece at a time.
    void count(Piece&);

    // Writes the pairs of all pieces into the lists of their tiles, unsorted.
    void enter(const std::vector<Piece>&);

    // Sorts each tile's pairs by (depth, uid).
    void sort();

    int64_t count() const { return count_; }
    Buffer<Pair> pairs;
    Buffer<int64_t> begin;    // of each tile's pairs, and the end of the last
    Buffer<uint32_t> places;  // of each Gaussian's first pair in the Gaussians' order, and the end of the last

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
    int spare_bits_ = 0;                         // keys are left-aligned, so that their leading bits vary
    std::vector<std::vector<uint32_t>> counts_;  // [worker][tile]: pairs counted, later where the next pair goes
    int64_t count_ = 0;
};

}  // namespace graings
