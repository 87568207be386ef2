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

// The instructions for products in bfloat16: "amx", "avx512bf16", or "" where there are none or avx512 is not in use.
std::string bfloat16_products();
std::vector<std::string> available_bfloat16_products();  // best first
void use_bfloat16_products(const std::string& name);     // for the whole process
const Bfloat16Kernels& bfloat16_kernels();  // throws std::invalid_argument where there are none

}  // namespace graings
