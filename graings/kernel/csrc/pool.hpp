// A pool of threads for loops over independent pieces.
#pragma once
#include <cstdint>
#include <functional>

namespace graings {

// Calls body(worker, piece) once for every piece in [0, pieces), on at most `threads` threads including the
// caller; worker < threads and is unique among bodies running at once. Pieces are handed out one at a time.
// The call does not wait for workers that have not started when the last piece is taken, so a busy core costs nothing.
// May be called from several threads at once, and in a child of fork(). If a body throws, the first exception is rethrown here.
void parallel_for(int threads, int64_t pieces, const std::function<void(int worker, int64_t piece)>& body);

}  // namespace graings
