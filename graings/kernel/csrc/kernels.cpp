// Compiled once per instruction set (CMakeLists.txt defines GRAINGS_ISA and the flags).
#include <type_traits>
#include "activation.hpp"
#include "geometry.hpp"
#include "layers.hpp"
#include "motion.hpp"
#include "ssim.hpp"
#include "tile_gradient.hpp"
#include "tiles.hpp"

namespace graings {

namespace GRAINGS_ISA {
template <class R>
constexpr Kernels<R> table() {
    return {project<R>, draw_tile<R>, tile_gradient<R>, geometry_gradient<R>, ssim_values<R>, ssim_gradient<R>, network_values<R>, network_gradient<R>,
            activate<R>, activate_gradient<R>, finish_colors<R>, move_children<R>, blend_children<R>};
}
extern const Kernels<float> single_precision;
extern const Kernels<double> double_precision;
const Kernels<float> single_precision = table<float>();
const Kernels<double> double_precision = table<double>();
}  // namespace GRAINGS_ISA

}  // namespace graings
