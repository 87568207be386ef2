// Selection of the instruction set: the best one of this CPU, unless GRAINGS_ISA or use_isa() names another.
#pragma once
#include <string>
#include <vector>
#include "types.hpp"

namespace graings {

std::vector<std::string> available_isas();   // best first
std::string active_isa();                    // throws std::invalid_argument when GRAINGS_ISA names an unusable one
void use_isa(const std::string& name);       // for the whole process
template <class R> const Kernels<R>& kernels();

// Products in bfloat16: where the CPU and its system have AMX, and avx512 is in use.
bool has_bfloat16_products();
const Bfloat16Kernels& bfloat16_kernels();  // throws std::invalid_argument where there are none

}  // namespace graings
