// Rank queries: how many of the taken slots come before a slot.
#pragma once
#include "types.hpp"

namespace graings::GRAINGS_ISA {

inline uint32_t rank(const Ranks* ranks, uint32_t place) {
    const Ranks& near = ranks[place / 64];
    return near.before + uint32_t(__builtin_popcountll(near.taken & ((uint64_t(1) << place % 64) - 1)));
}

}  // namespace graings::GRAINGS_ISA
