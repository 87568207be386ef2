// Python bindings of prepared.hpp.
#include "prepared.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

#include "arrays.hpp"

namespace {

// A network with one hidden layer of `inputs` inputs, to which the feature's part `hidden` [anchors, width] is added.
template <class R>
graings::Network<R> head(const In<R>& hidden, int64_t anchors, const std::vector<In<R>>& w, const std::vector<In<R>>& b, size_t inputs) {
    if (w.size() != 2 || b.size() != 2 || w[0].shape(1) != inputs) throw std::invalid_argument("a head has two layers, the first of all its inputs");
    graings::Network<R> result;
    result.widths = {int64_t(inputs), int64_t(w[0].shape(0)), int64_t(w[1].shape(0))};
    for (size_t l = 0; l < 2; l++) {
        const size_t in = size_t(result.widths[l]), out = size_t(result.widths[l + 1]);
        result.weights.push_back(checked(w[l], in * out, "weight")), result.biases.push_back(checked(b[l], out, "bias"));
    }
    result.groups = anchors, result.shared = checked(hidden, size_t(anchors * result.widths[1]), "hidden");
    return result;
}

graings::Activation activation(int kind) {
    if (kind != graings::kSigmoid && kind != graings::kTanh) throw std::invalid_argument("kind must be 0 (sigmoid) or 1 (tanh)");
    return graings::Activation(kind);
}

template <class R>
void bind(nb::module_& m) {
    m.def("activate", [](int kind, In<R> x, Out<R> out, int threads) {
        R* to = checked(out, x.size(), "out");
        const auto function = activation(kind);
        nb::gil_scoped_release release;
        graings::activate<R>(function, int64_t(x.size()), x.data(), to, threads);
    });
    m.def("activate_gradient", [](int kind, In<R> x, In<R> v, Out<R> out, int threads) {
        const R* upstream = checked(v, x.size(), "v");
        R* to = checked(out, x.size(), "out");
        const auto function = activation(kind);
        nb::gil_scoped_release release;
        graings::activate_gradient<R>(function, int64_t(x.size()), x.data(), upstream, to, threads);
    });
    m.def("directions", [](In<R> position, In<double> eye, double nearest, Out<R> out, int threads) {
        const double* from = checked(eye, 3, "eye");
        const size_t rows = position.size() / 3;
        R* to = checked(out, 3 * rows, "out");
        nb::gil_scoped_release release;
        graings::directions<R>(int64_t(rows), position.data(), from, nearest, to, threads);
    });
    m.def("choose", [](In<int64_t> slots, In<int64_t> children, In<int64_t> uids, In<R> opacities, std::optional<In<R>> hidden, std::vector<In<R>> weights,
                       std::vector<In<R>> biases, std::optional<Out<R>> change, std::optional<In<R>> blended, double bound, double threshold, Out<int64_t> out_rows,
                       Out<int64_t> out_slots, Out<int64_t> out_children, Out<int64_t> out_uids, Out<R> out_opacities, std::optional<Out<R>> out_changes, int threads) {
        const size_t count = slots.size();
        graings::Shown<R> in{int64_t(count), 0, slots.data(), checked(children, count, "children"), checked(uids, count, "uids"), opacities.data(), {}, nullptr, nullptr, bound, threshold};
        if (blended) {
            if (blended->size() < count * graings::kBlended) throw std::invalid_argument("blended must have four values for each slot");
            in.blended = blended->data();
        }
        if (hidden && change) {
            in.anchors = int64_t(hidden->shape(0));
            in.residual = head(*hidden, in.anchors, weights, biases, 0);
            in.change = checked(*change, size_t(in.anchors * in.residual.widths[2]), "change");
            if (opacities.size() && change->size() % opacities.size()) throw std::invalid_argument("change must have the same number of values for each slot");
        }
        const graings::Rendered<R> out{checked(out_rows, count, "rows"), checked(out_slots, count, "slots"), checked(out_children, count, "children"),
                                       checked(out_uids, count, "uids"), checked(out_opacities, count, "opacities"),
                                       blended ? checked(out_changes, 3 * count, "changes") : nullptr};
        nb::gil_scoped_release release;
        return graings::choose<R>(in, int64_t(opacities.size()), out, threads);
    });
    m.def("blend", [](In<R> weights, In<int64_t> begin, In<int32_t> units, In<R> state, In<R> functions, Out<R> out, int threads) {
        const size_t blocks = state.size() / (graings::kBlended * graings::kMoving), rank = functions.size() / graings::kBlended;
        const int64_t* starts = checked(begin, blocks + 1, "begin");
        if (starts[0] != 0 || !std::is_sorted(starts, starts + blocks + 1)) throw std::invalid_argument("begin must ascend from 0");
        const int32_t* numbers = checked(units, size_t(starts[blocks]), "units");
        if (units.size() && size_t(*std::max_element(numbers, numbers + units.size())) >= rank) throw std::invalid_argument("units must be functions");
        const graings::BlendArgs<R> args{checked(weights, units.size() * graings::kMoving, "weights"), starts, numbers, state.data(), functions.data(),
                                         checked(out, state.size(), "out")};
        nb::gil_scoped_release release;
        graings::blend<R>(args, int64_t(blocks), threads);
    });
    m.def("move", [](In<R> hidden, In<int64_t> begin, In<int32_t> units, In<R> rest, In<R> weights, In<R> bias, double extent, double change, double low, double high,
                     In<int64_t> rows, Out<R> mean, Out<R> quat, Out<R> log_scale, int threads) {
        if (!begin.size()) throw std::invalid_argument("begin must have an entry for each block and one more");
        const size_t blocks = begin.size() - 1, width = weights.size() / graings::kOffsets, drawn = rows.size();
        checked(weights, width * graings::kOffsets, "weights");
        const int64_t* starts = begin.data();
        if (starts[0] != 0 || !std::is_sorted(starts, starts + begin.size())) throw std::invalid_argument("begin must ascend from 0");
        const int32_t* numbers = checked(units, size_t(starts[blocks]), "units");  // in range since ActiveUnits made them: to look costs a fifth of the call
        std::vector<R> by_unit(width * graings::kOffsets), constant(graings::kOffsets);
        const R *from = weights.data(), *without = checked(bias, graings::kOffsets, "bias");
        for (size_t c = 0; c < graings::kOffsets; c++) {
            constant[c] = without[c];
            for (size_t k = 0; k < width; k++) {
                const R weight = by_unit[k * graings::kOffsets + c] = from[c * width + k];
                if (!std::isfinite(weight)) constant[c] = std::numeric_limits<R>::quiet_NaN();  // counts where its unit is left out too
            }
        }
        const graings::MoveArgs<R> args{checked(hidden, units.size() * graings::kMoving, "hidden"),
                                        starts, numbers,
                                        checked(rest, blocks * graings::kOffsets * graings::kMoving, "rest"),
                                        by_unit.data(), constant.data(),
                                        R(extent), R(change), R(low), R(high),
                                        rows.data(),
                                        checked(mean, 3 * drawn, "mean"), checked(quat, 4 * drawn, "quat"), checked(log_scale, 3 * drawn, "log_scale")};
        nb::gil_scoped_release release;
        graings::move<R>(args, int64_t(blocks) * graings::kMoving, int64_t(drawn), threads);
    });
    m.def("paint", [](In<R> position, std::optional<In<R>> normals, int degree, In<R> hidden, std::vector<In<R>> weights, std::vector<In<R>> biases, int residual_degree,
                      std::optional<In<R>> residual_hidden, std::vector<In<R>> residual_weights, std::vector<In<R>> residual_biases, std::optional<In<R>> time_only,
                      std::optional<In<R>> blended, double bound, In<double> eye, double nearest, In<int64_t> children, std::optional<In<double>> frustum,
                      std::optional<In<R>> mean, std::optional<In<R>> log_scale, Out<R> colors, int threads) {
        const int64_t anchors = int64_t(position.size() / 3);
        graings::ColorNetworks<R> in{anchors, 0, position.data(), checked(normals, position.size(), "normals"), degree, {}, residual_degree, {}, nullptr, nullptr, bound};
        in.canonical = head(hidden, anchors, weights, biases, harmonics_of(degree) * (normals ? 2 : 1));
        in.slots = in.canonical.widths[2] / 3;
        if (in.canonical.widths[2] != 3 * in.slots) throw std::invalid_argument("a colour network has three outputs per slot");
        if (residual_degree) {
            if (!residual_hidden) throw std::invalid_argument("the residual network needs its hidden layer");
            in.residual = head(*residual_hidden, anchors, residual_weights, residual_biases, harmonics_of(residual_degree));
            if (in.residual.widths[2] != 3 * in.slots) throw std::invalid_argument("colour and residual must have the same slots");
        }
        in.time_only = checked(time_only, size_t(4 * anchors * in.slots), "time_only");
        in.blended = checked(blended, 3 * children.size(), "blended");
        const double* from = checked(eye, 3, "eye");
        R* out = checked(colors, 3 * children.size(), "colors");
        graings::Frustum seen{};
        static_assert(sizeof seen == 21 * sizeof(double));
        if (const double* numbers = checked(frustum, 21, "frustum")) std::memcpy(&seen, numbers, sizeof seen);
        const graings::Wanted<R> wanted{int64_t(children.size()), children.data(), frustum ? &seen : nullptr, checked(mean, 3 * children.size(), "mean"),
                                        checked(log_scale, 3 * children.size(), "log_scale")};
        if (frustum && !(mean && log_scale)) throw std::invalid_argument("a frustum needs mean and log_scale");
        nb::gil_scoped_release release;
        graings::paint<R>(in, from, nearest, wanted, out, threads);
    });
}

}  // namespace

void bind_prepared(nb::module_& m);
void bind_prepared(nb::module_& m) {
    bind<float>(m);
    bind<double>(m);
}
