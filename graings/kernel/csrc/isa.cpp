#include "isa.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>
#if defined(GRAINGS_AMX) && defined(__linux__)
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
#ifdef GRAINGS_AMX
namespace amx { extern const Bfloat16Kernels bfloat16; }
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

// Whether this CPU has AMX for bfloat16, and its system lets this process use it.
bool has_amx() {
#if defined(GRAINGS_AMX) && defined(__linux__)
    __builtin_cpu_init();
    if (!__builtin_cpu_supports("avx512bf16") || !__builtin_cpu_supports("amx-tile") || !__builtin_cpu_supports("amx-bf16")) return false;
    constexpr int kRequest = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA: Linux saves tile registers after a request
    return syscall(SYS_arch_prctl, kRequest, kTileData) == 0;
#else
    return false;
#endif
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

bool has_bfloat16_products() {
    static const bool found = has_amx();
    return found && active_isa() == "avx512";
}

const Bfloat16Kernels& bfloat16_kernels() {
#ifdef GRAINGS_AMX
    if (has_bfloat16_products()) return amx::bfloat16;
#endif
    throw std::invalid_argument("this CPU has no AMX for products in bfloat16, or GRAINGS_ISA leaves it out");
}

template <> const Kernels<float>& kernels<float>() { return *entry().single_precision; }
template <> const Kernels<double>& kernels<double>() { return *entry().double_precision; }

}  // namespace graings
