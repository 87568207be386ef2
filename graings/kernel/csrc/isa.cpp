#include "isa.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>
#if defined(GRAINGS_BFLOAT16) && defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace graings {

#define GRAINGS_DECLARE(isa)                            \
    namespace isa {                                     \
    extern const Kernels<float> single_precision;       \
    extern const Kernels<double> double_precision;      \
    }
GRAINGS_DECLARE(generic)
#ifdef GRAINGS_X86
GRAINGS_DECLARE(avx2)
GRAINGS_DECLARE(avx512)
#endif
#ifdef GRAINGS_BFLOAT16
namespace amx { extern const Bfloat16Kernels bfloat16; }
namespace avx512bf16 { extern const Bfloat16Kernels bfloat16; }
#endif

namespace {

struct Entry {
    const char* name;
    bool (*runs_here)();
    const Kernels<float>* single_precision;
    const Kernels<double>* double_precision;
};

const Entry kEntries[] = {
#ifdef GRAINGS_X86
    {"avx512",
     [] {
         __builtin_cpu_init();
         return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
                __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma");
     },
     &avx512::single_precision, &avx512::double_precision},
    {"avx2", [] { __builtin_cpu_init(); return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"); },
     &avx2::single_precision, &avx2::double_precision},
#endif
    {"generic", [] { return true; }, &generic::single_precision, &generic::double_precision},
};

struct Bfloat16Entry {
    const char* name;
    bool (*runs_here)();
    const Bfloat16Kernels* kernels;
};

#ifdef GRAINGS_BFLOAT16
// Linux saves the tile registers of a process only after a request.
bool tiles_are_permitted() {
#ifdef __linux__
    constexpr int kRequest = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return syscall(SYS_arch_prctl, kRequest, kTileData) == 0;
#else
    return false;
#endif
}
#endif

const Bfloat16Entry kBfloat16Entries[] = {
#ifdef GRAINGS_BFLOAT16
    {"amx",
     [] {
         __builtin_cpu_init();
         return __builtin_cpu_supports("avx512bf16") && __builtin_cpu_supports("amx-tile") && __builtin_cpu_supports("amx-bf16") && tiles_are_permitted();
     },
     &amx::bfloat16},
    {"avx512bf16", [] { __builtin_cpu_init(); return bool(__builtin_cpu_supports("avx512bf16")); }, &avx512bf16::bfloat16},
#endif
    {nullptr, [] { return true; }, nullptr},  // none
};

std::atomic<const Bfloat16Entry*> active_bfloat16{nullptr};

const Bfloat16Entry& bfloat16_entry() {
    const Bfloat16Entry* chosen = active_bfloat16.load(std::memory_order_acquire);
    if (chosen) return *chosen;
    chosen = kBfloat16Entries;
    while (!chosen->runs_here()) chosen++;
    active_bfloat16.store(chosen, std::memory_order_release);
    return *chosen;
}

std::atomic<const Entry*> active{nullptr};

const Entry* find(const std::string& name) {
    for (const Entry& entry : kEntries)
        if (name == entry.name && entry.runs_here()) return &entry;
    std::string known;
    for (const auto& isa : available_isas()) known += (known.empty() ? "" : ", ") + isa;
    throw std::invalid_argument("instruction set '" + name + "' is not available here; choose one of: " + known);
}

const Entry& entry() {
    const Entry* chosen = active.load(std::memory_order_acquire);
    if (chosen) return *chosen;
    const char* requested = std::getenv("GRAINGS_ISA");
    if (requested && *requested) chosen = find(requested);
    else
        for (const Entry& candidate : kEntries)
            if (candidate.runs_here()) { chosen = &candidate; break; }
    active.store(chosen, std::memory_order_release);
    return *chosen;
}

}  // namespace

std::vector<std::string> available_isas() {
    std::vector<std::string> names;
    for (const Entry& candidate : kEntries)
        if (candidate.runs_here()) names.emplace_back(candidate.name);
    return names;
}

std::string active_isa() { return entry().name; }
void use_isa(const std::string& name) { active.store(find(name), std::memory_order_release); }

std::string bfloat16_products() { return active_isa() == "avx512" && bfloat16_entry().name ? bfloat16_entry().name : ""; }

std::vector<std::string> available_bfloat16_products() {
    std::vector<std::string> names;
    for (const Bfloat16Entry& candidate : kBfloat16Entries)
        if (candidate.name && candidate.runs_here()) names.emplace_back(candidate.name);
    return names;
}

void use_bfloat16_products(const std::string& name) {
    for (const Bfloat16Entry& candidate : kBfloat16Entries)
        if (candidate.name && name == candidate.name && candidate.runs_here()) return active_bfloat16.store(&candidate, std::memory_order_release);
    throw std::invalid_argument("products in bfloat16 by '" + name + "' are not available here");
}

const Bfloat16Kernels& bfloat16_kernels() {
    if (bfloat16_products().empty()) throw std::invalid_argument("this CPU has no instructions for products in bfloat16, or GRAINGS_ISA leaves them out");
    return *bfloat16_entry().kernels;
}

template <> const Kernels<float>& kernels<float>() { return *entry().single_precision; }
template <> const Kernels<double>& kernels<double>() { return *entry().double_precision; }

}  // namespace graings
