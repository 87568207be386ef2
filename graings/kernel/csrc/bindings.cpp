// Python bindings. Arrays are passed through DLPack, so the kernel does not depend on torch.
#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <iterator>
#include <optional>
#include <stdexcept>
#include <string>
#ifdef __GLIBC__
#include <malloc.h>
#endif

#include "arrays.hpp"
#include "children.hpp"
#include "colors.hpp"
#include "encoding.hpp"
#include "frame.hpp"
#include "isa.hpp"
#include "perceptron.hpp"
#include "photometric.hpp"

using namespace nb::literals;

namespace {

// Frames take memory addresses, 0 for null: array arguments would cost a fifth of the time of a small frame. The caller
// has checked shapes, dtypes and contiguity.
using Address = uintptr_t;
template <class T> T* at(Address address) { return reinterpret_cast<T*>(address); }
template <class T> T* needed(Address address, int64_t count, const char* name) {
    if (!address && count) throw std::invalid_argument(std::string(name) + " must not be null");
    return at<T>(address);
}

template <class R>
graings::Inputs<R> inputs(int64_t count, Address means, Address quats, Address log_scales, Address opacities, Address colors, Address background, Address offset) {
    return {count, needed<R>(means, count, "means"), needed<R>(quats, count, "quats"), needed<R>(log_scales, count, "log_scales"), needed<R>(opacities, count, "opacities"),
            needed<R>(colors, count, "colors"), at<R>(offset), needed<R>(background, 3, "background")};
}

template <class R>
graings::Anchors<R> anchors(const In<R>& position, const In<R>& log_scale, const In<R>& offset) {
    const size_t count = position.shape(0), slots = offset.shape(1);
    return {int64_t(count), int64_t(slots), checked(position, 3 * count, "position"), checked(log_scale, 3 * count, "log_scales"), checked(offset, 3 * count * slots, "offsets")};
}

template <class R>
graings::NetworkOutputs<R> network_outputs(const In<R>& canonical, const In<R>& base, const In<R>& centre, const std::optional<In<R>>& deformation, double extent, double change,
                            double low, double high, bool projected) {
    const size_t drawn = base.shape(0);
    if (deformation && deformation->ndim() != 3) throw std::invalid_argument("deformation must be [gaussian, time, 10]");
    const size_t times = deformation ? deformation->shape(1) : 1;
    return {int64_t(drawn), int64_t(times), checked(canonical, 7 * drawn, "canonical"), checked(base, 3 * drawn, "base"), checked(centre, 3 * drawn, "centre"),
            checked(deformation, 10 * drawn * times, "deformation"), extent, {change, low, high, projected}};
}

// Of each time; None is zero.
template <class R> using Gradients = std::vector<std::optional<In<R>>>;

template <class R>
std::vector<const R*> of_each_time(const Gradients<R>& arrays, const graings::NetworkOutputs<R>& in, size_t width, const char* name) {
    if (arrays.size() != size_t(in.times)) throw std::invalid_argument(std::string(name) + " must have an array or None for each time");
    std::vector<const R*> pointers;
    for (const auto& array : arrays) pointers.push_back(checked(array, width * size_t(in.drawn), name));
    return pointers;
}

template <class R>
graings::ColorOutputs<R> color_outputs(const In<R>& color, const std::optional<In<R>>& residual, const In<int64_t>& children, double bound, bool projected) {
    const size_t slots = color.size() / 3;
    return {int64_t(slots), int64_t(children.size()), children.data(), checked(color, 3 * slots, "color"), checked(residual, 4 * slots, "residual"), bound, projected};
}

template <class R>
graings::Products products_in(bool bfloat16) {
    if (bfloat16 && !std::is_same_v<R, float>) throw std::invalid_argument("products in bfloat16 are for float32");
    if (bfloat16) graings::bfloat16_kernels();  // throws where there are none
    return bfloat16 ? graings::kInBfloat16 : graings::kAsStored;
}

template <class R>
void bind_children(nb::module_& m) {
    m.def("gather", [](In<R> position, In<R> log_scale, In<R> offset, In<int64_t> children, Out<R> row, Out<R> centre, Out<R> base, int threads) {
        const auto from = anchors<R>(position, log_scale, offset);
        const size_t drawn = children.size();
        R *rows = checked(row, drawn * size_t(3 + from.slots), "row"), *centres = checked(centre, 3 * drawn, "centre");
        R* bases = checked(base, 3 * drawn, "base");
        nb::gil_scoped_release release;
        graings::gather<R>(from, int64_t(drawn), children.data(), rows, centres, bases, threads);
    });
    m.def("gather_gradient", [](In<R> position, In<R> log_scale, In<R> offset, In<int64_t> children, In<R> v_row, In<R> v_centre, In<R> v_base, Out<R> v_log_scale,
                                Out<R> v_offset, int threads) {
        const auto from = anchors<R>(position, log_scale, offset);
        const size_t drawn = children.size();
        const R *row = checked(v_row, drawn * size_t(3 + from.slots), "v_row"), *centre = checked(v_centre, 3 * drawn, "v_centre");
        const R* base = checked(v_base, 3 * drawn, "v_base");
        R *scales = checked(v_log_scale, log_scale.size(), "v_log_scale"), *offsets = checked(v_offset, offset.size(), "v_offset");
        nb::gil_scoped_release release;
        graings::gather_gradient<R>(from, int64_t(drawn), children.data(), row, centre, base, scales, offsets, threads);
    });
    m.def("compose", [](In<R> canonical, In<R> base, In<R> centre, std::optional<In<R>> deformation, double extent, double change, double low, double high, bool projected,
                        Out<R> mean, Out<R> quat, Out<R> log_scale, std::optional<Out<R>> shift, int threads) {
        const auto in = network_outputs<R>(canonical, base, centre, deformation, extent, change, low, high, projected);
        const size_t rows = size_t(in.drawn * in.times);
        R *means = checked(mean, 3 * rows, "mean"), *quats = checked(quat, 4 * rows, "quat"), *scales = checked(log_scale, 3 * rows, "log_scale");
        R* shifts = checked(shift, 3 * rows, "shift");
        if (bool(shifts) != bool(in.deformation)) throw std::invalid_argument("deformation and shift must be given together");
        nb::gil_scoped_release release;
        graings::compose<R>(in, means, quats, scales, shifts, threads);
    });
    m.def("compose_gradient", [](In<R> canonical, In<R> base, In<R> centre, std::optional<In<R>> deformation, double extent, double change, double low, double high,
                                 bool projected, Gradients<R> v_mean, Gradients<R> v_quat, Gradients<R> v_log_scale, Gradients<R> v_shift, Out<R> v_canonical,
                                 Out<R> v_base, Out<R> v_centre, std::optional<Out<R>> v_deformation, int threads) {
        const auto in = network_outputs<R>(canonical, base, centre, deformation, extent, change, low, high, projected);
        const size_t drawn = size_t(in.drawn);
        const graings::GeometryGradients<R> upstream{of_each_time<R>(v_mean, in, 3, "v_mean"), of_each_time<R>(v_quat, in, 4, "v_quat"),
                                                     of_each_time<R>(v_log_scale, in, 3, "v_log_scale"), of_each_time<R>(v_shift, in, 3, "v_shift")};
        R *out = checked(v_canonical, 7 * drawn, "v_canonical"), *out_deformation = checked(v_deformation, 10 * drawn * size_t(in.times), "v_deformation");
        R *out_base = checked(v_base, 3 * drawn, "v_base"), *out_centre = checked(v_centre, 3 * drawn, "v_centre");
        if (bool(out_deformation) != bool(in.deformation)) throw std::invalid_argument("deformation and v_deformation must be given together");
        nb::gil_scoped_release release;
        graings::compose_gradient<R>(in, upstream, out, out_base, out_centre, out_deformation, threads);
    });
    m.def("child_colors", [](In<R> color, std::optional<In<R>> residual, In<int64_t> children, double bound, bool projected, std::optional<Out<R>> change, Out<R> sum,
                             std::optional<Out<R>> drawn_color, int threads) {
        const auto in = color_outputs<R>(color, residual, children, bound, projected);
        const size_t drawn = children.size();
        if (change.has_value() != residual.has_value() || drawn_color.has_value() != residual.has_value())
            throw std::invalid_argument("residual, change and drawn_color must be given together");
        R *changes = checked(change, 4 * drawn, "change"), *sums = checked(sum, 3 * drawn, "sum"), *to = checked(drawn_color, 3 * drawn, "drawn_color");
        nb::gil_scoped_release release;
        graings::child_colors<R>(in, changes, sums, to, threads);
    });
    m.def("child_colors_gradient", [](In<R> color, std::optional<In<R>> residual, In<int64_t> children, double bound, bool projected, In<R> sum,
                                      std::optional<In<R>> v_drawn_color, std::optional<In<R>> v_change, Out<R> v_color, std::optional<Out<R>> v_residual, int threads) {
        const auto in = color_outputs<R>(color, residual, children, bound, projected);
        const size_t drawn = children.size();
        if (v_residual.has_value() != residual.has_value()) throw std::invalid_argument("residual and v_residual must be given together");
        const R *sums = checked(sum, 3 * drawn, "sum"), *colors = checked(v_drawn_color, 3 * drawn, "v_drawn_color"), *changes = checked(v_change, 4 * drawn, "v_change");
        R *to = checked(v_color, color.size(), "v_color"), *to_residual = checked(v_residual, 4 * size_t(in.slots), "v_residual");
        nb::gil_scoped_release release;
        graings::child_colors_gradient<R>(in, sums, colors, changes, to, to_residual, threads);
    });
}

template <class R>
void bind(nb::module_& m, const char* frame_name, const char* draw_name) {
    using graings::Frame;
    nb::class_<Frame<R>>(m, frame_name)
        .def_prop_ro("culled", [](const Frame<R>& frame) {
            nb::dict counts;
            const char* names[] = {"non_finite", "zero_quat", "behind", "faint", "outside"};
            for (int i = 0; i < 5; i++) counts[names[i]] = frame.statuses()[graings::kNonFinite + i];
            return counts;
        })
        .def_prop_ro("seconds", [](const Frame<R>& frame) {
            nb::dict stages;
            const char* names[] = {"project", "bin", "sort", "blend", "blend gradient", "geometry gradient"};
            for (int i = 0; i < graings::kStages; i++) stages[names[i]] = frame.seconds()[i];
            return stages;
        }, "Seconds of each stage.")
        .def_prop_ro("pairs", &Frame<R>::pairs, "Number of (tile, Gaussian) pairs.")
        .def_prop_ro("evaluated", &Frame<R>::evaluated, "Number of (pixel, Gaussian) pairs that were evaluated.")
        .def("pixels_gradient",
             [](Frame<R>& frame, Address background, Address v_color, Address v_alpha, Address v_depth, Address g_background, int threads) {
                 const R *ground = needed<R>(background, 1, "background"), *color = needed<R>(v_color, 1, "v_color");
                 nb::gil_scoped_release release;
                 frame.pixels_gradient(ground, color, at<R>(v_alpha), at<R>(v_depth), at<R>(g_background), threads);
             })
        .def("gaussians_gradient",
             [](Frame<R>& frame, int64_t count, Address means, Address quats, Address log_scales, Address opacities, Address colors, Address background,
                Address offset, Address g_means, Address g_quats, Address g_log_scales, Address g_opacities, Address g_colors, Address g_offset, int threads) {
                 const auto in = inputs<R>(count, means, quats, log_scales, opacities, colors, background, offset);
                 const graings::Gradients<R> out{at<R>(g_means), at<R>(g_quats), at<R>(g_log_scales), at<R>(g_opacities), at<R>(g_colors), at<R>(g_offset)};
                 nb::gil_scoped_release release;
                 frame.gaussians_gradient(in, out, threads);
             });
    m.def(draw_name,
          [](int64_t count, Address means, Address quats, Address log_scales, Address opacities, Address colors, Address background, Address offset, Address uids,
             In<double> pose, In<double> center, double fx, double fy, double cx, double cy, int64_t width, int64_t height, double alpha_min,
             double transmittance_min, double alpha_max, double blur, double near, double far, double frustum_margin, bool compat, Address color, Address alpha,
             Address depth, Address means2d, Address radii, int threads, bool gradient) {
              const auto in = inputs<R>(count, means, quats, log_scales, opacities, colors, background, offset);
              graings::Camera camera{{}, {}, fx, fy, cx, cy, width, height};
              for (int row = 0; row < 3; row++) std::copy_n(checked(pose, 16, "pose") + 4 * row, 3, camera.rotation + 3 * row);
              std::copy_n(checked(center, 3, "center"), 3, camera.center);
              const graings::Settings settings{alpha_min, transmittance_min, alpha_max, blur, near, far, frustum_margin, compat};
              const graings::Outputs<R> out{at<R>(color), at<R>(alpha), at<R>(depth), at<R>(means2d), at<R>(radii)};
              nb::gil_scoped_release release;
              return new Frame<R>(camera, settings, in, needed<int64_t>(uids, count, "uids"), out, threads, gradient);
          },
          nb::rv_policy::take_ownership);
    m.def("encode", [](In<R> x, int64_t dimensions, int octaves, Out<R> encoded, int threads) {
        if (dimensions < 1 || octaves < 0 || x.size() % size_t(dimensions)) throw std::invalid_argument("x must hold rows of `dimensions` numbers");
        const size_t rows = x.size() / size_t(dimensions);
        R* out = checked(encoded, rows * size_t(dimensions * (1 + 2 * octaves)), "encoded");
        nb::gil_scoped_release release;
        graings::encode<R>(int64_t(rows), dimensions, octaves, x.data(), out, threads);
    });
    m.def("encode_directions", [](In<R> directions, std::optional<In<R>> normals, int degree, Out<R> encoded, int threads) {
        const size_t rows = directions.size() / 3, width = harmonics_of(degree) * (normals ? 2 : 1);
        const R *from = checked(directions, 3 * rows, "directions"), *at = checked(normals, 3 * rows, "normals");
        R* out = checked(encoded, rows * width, "encoded");
        nb::gil_scoped_release release;
        graings::encode_directions<R>(int64_t(rows), degree, from, at, out, threads);
    });
    m.def("encode_directions_gradient", [](In<R> directions, In<R> normals, int degree, In<R> v_encoded, Out<R> v_normals, int threads) {
        const size_t rows = directions.size() / 3;
        const R *from = checked(directions, 3 * rows, "directions"), *at = checked(normals, 3 * rows, "normals");
        const R* upstream = checked(v_encoded, 2 * rows * harmonics_of(degree), "v_encoded");
        R* out = checked(v_normals, 3 * rows, "v_normals");
        nb::gil_scoped_release release;
        graings::encode_directions_gradient<R>(int64_t(rows), degree, from, at, upstream, out, threads);
    });
    m.def("network", [](In<R> input, std::vector<In<R>> weights, std::vector<In<R>> biases, std::optional<In<R>> shared, std::optional<In<int64_t>> group,
                        Out<R> output, std::optional<Out<R>> hidden, bool bfloat16, int threads) {
        const int64_t rows = int64_t(input.shape(0));
        const auto layers = network<R>(input, rows, weights, biases, shared, group);
        R* out = checked(output, size_t(rows * layers.widths.back()), "output");
        const auto products = products_in<R>(bfloat16);
        R* kept = checked(hidden, size_t(graings::hidden_size(layers.widths, rows, products)), "hidden");
        nb::gil_scoped_release release;
        graings::evaluate<R>(layers, rows, input.data(), out, kept, products, threads);
    });
    m.def("network_gradient", [](In<R> input, std::vector<In<R>> weights, std::vector<In<R>> biases, std::optional<In<R>> shared, std::optional<In<int64_t>> group,
                                 Out<R> hidden, In<R> v_output, std::optional<Out<R>> v_input, std::vector<Out<R>> v_weights, std::vector<Out<R>> v_biases,
                                 std::optional<Out<R>> v_shared, bool bfloat16, int threads) {
        const int64_t rows = int64_t(input.shape(0));
        const auto layers = network<R>(input, rows, weights, biases, shared, group);
        const R* upstream = checked(v_output, size_t(rows * layers.widths.back()), "v_output");
        const auto products = products_in<R>(bfloat16);
        R* kept = checked(hidden, size_t(graings::hidden_size(layers.widths, rows, products)), "hidden");
        R *v_in = checked(v_input, input.size(), "v_input"), *v_common = checked(v_shared, shared ? shared->size() : 0, "v_shared");
        if (shared && !v_shared) throw std::invalid_argument("shared needs v_shared for its gradient");
        if (v_weights.size() != weights.size() || v_biases.size() != weights.size()) throw std::invalid_argument("one gradient per weight and bias");
        std::vector<R*> w, b;
        for (size_t l = 0; l < weights.size(); l++) {
            w.push_back(checked(v_weights[l], weights[l].size(), "weight gradient"));
            b.push_back(checked(v_biases[l], biases[l].size(), "bias gradient"));
        }
        nb::gil_scoped_release release;
        graings::differentiate<R>(layers, rows, input.data(), kept, upstream, v_in, w, b, v_common, products, threads);
    });
    m.def("compare", [](In<R> image, In<R> target, int64_t height, int64_t width, double similarity, double absolute, double squared, std::optional<Out<R>> gradient, int threads) {
        const size_t size = size_t(3 * height * width);
        const R *first = checked(image, size, "image"), *second = checked(target, size, "target");
        R* out = checked(gradient, size, "gradient");
        nb::gil_scoped_release release;
        const auto mean = graings::compare<R>(height, width, first, second, {similarity, absolute, squared}, out, threads);
        return std::tuple(mean.similarity, mean.absolute, mean.squared);
    });
}

}  // namespace

void bind_prepared(nb::module_&);  // prepared_bindings.cpp

NB_MODULE(_kernel, m) {
    nb::set_leak_warnings(false);  // torch may keep graphs, and with them frames, until the interpreter exits
    m.doc() = "Compiled rasterizer; use graings.raster.rasterize and graings.raster.photometric.";
    bind<float>(m, "FrameFloat", "draw_float");
    bind<double>(m, "FrameDouble", "draw_double");
    bind_children<float>(m);
    bind_children<double>(m);
    bind_prepared(m);
    m.def("hidden_size", [](const std::vector<int64_t>& widths, int64_t rows, bool bfloat16) {
        return graings::hidden_size(widths, rows, bfloat16 ? graings::kInBfloat16 : graings::kAsStored);
    }, "widths"_a, "rows"_a, "bfloat16"_a, "Elements that a network's hidden activations take.");
    m.def("has_bfloat16_products", &graings::has_bfloat16_products, "Whether networks can have products in bfloat16 here.");
    m.def("ssim_constants", [] {
        nb::dict constants;
        constants["taps"] = std::vector<double>(std::begin(graings::kSsimTaps), std::end(graings::kSsimTaps));
        constants["c1"] = graings::kSsimC1, constants["c2"] = graings::kSsimC2;
        return constants;
    }, "What `compare` is compiled with: the window's taps from its centre outwards, C1 and C2.");
    m.def("keep_freed_memory", [] {
#ifdef __GLIBC__
        // Not M_MMAP_THRESHOLD: glibc accepts 32 MB at most, and activations of 21 000 rows of 3 x 128 are larger.
        mallopt(M_MMAP_MAX, 0);
        mallopt(M_TRIM_THRESHOLD, 1 << 30);
#endif
    });
    m.def("available_isas", &graings::available_isas, "Instruction sets this CPU can run, best first.");
    m.def("active_isa", &graings::active_isa, "The instruction set in use.");
    m.def("use_isa", &graings::use_isa, "name"_a, "Select an instruction set for the whole process.");
}
