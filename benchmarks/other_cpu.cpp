// Runs the rasterizer, the loss and a network on generated inputs and writes the results: for each array a line with its
// name and length, then its numbers as float64. A stand-alone program for CPUs without an interpreter (other_cpu.py).
// Inputs are generated from integers, so that they are the same on every CPU.
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

#include "children.hpp"
#include "encoding.hpp"
#include "frame.hpp"
#include "perceptron.hpp"
#include "photometric.hpp"

namespace {

class Numbers {
public:
    double between(double low, double high) {
        state_ += 0x9E3779B97F4A7C15;
        uint64_t z = state_;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9, z = (z ^ (z >> 27)) * 0x94D049BB133111EB;
        return low + (high - low) * double((z ^ (z >> 31)) >> 11) * 0x1p-53;
    }
    template <class R>
    std::vector<R> many(size_t count, double low, double high) {
        std::vector<R> all(count);
        for (R& one : all) one = R(float(between(low, high)));  // the same in both precisions
        return all;
    }

private:
    uint64_t state_ = 1;
};

template <class R>
void write(const char* name, const std::vector<R>& numbers) {
    const std::vector<double> wide(numbers.begin(), numbers.end());
    std::printf("%s%s %zu\n", name, sizeof(R) == 4 ? "/float32" : "/float64", wide.size());
    std::fwrite(wide.data(), sizeof(double), wide.size(), stdout);
}

template <class R>
void images() {
    constexpr int64_t count = 3000, width = 163, height = 118, pixels = width * height;  // with incomplete tiles
    Numbers from;
    auto means = from.many<R>(3 * count, -1.5, 1.5), quats = from.many<R>(4 * count, -1, 1), log_scales = from.many<R>(3 * count, -6, -2);
    const auto opacities = from.many<R>(count, 0, 1), colors = from.many<R>(3 * count, 0, 1), background = from.many<R>(3, 0, 1);
    for (int64_t i = 0; i < count; i++) means[size_t(3 * i + 2)] += R(4);
    for (int64_t i = 0; i < 100; i++) log_scales[size_t(3 * i)] = R(1);  // needles across the image
    std::vector<int64_t> uids(count);
    for (int64_t i = 0; i < count; i++) uids[size_t(i)] = i;
    const graings::Camera camera{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}, 180, 180, 80.5, 60.25, width, height};
    const graings::Settings settings{1.0 / 255, 1e-4, 0.99, 0.3, 0.01, 1e30, 0.3, false};
    const graings::Inputs<R> in{count, means.data(), quats.data(), log_scales.data(), opacities.data(), colors.data(), nullptr, background.data()};
    std::vector<R> color(3 * pixels), alpha(pixels), depth(pixels), means2d(2 * count), radii(2 * count);
    graings::Frame<R> frame(camera, settings, in, uids.data(), {color.data(), alpha.data(), depth.data(), means2d.data(), radii.data()}, 2, true);
    write("color", color), write("alpha", alpha), write("depth", depth), write("means2d", means2d), write("radii", radii);
    const auto v_color = from.many<R>(3 * pixels, -1, 1), v_alpha = from.many<R>(pixels, -1, 1), v_depth = from.many<R>(pixels, -1, 1);
    std::vector<R> v_background(3), v_means(3 * count), v_quats(4 * count), v_log_scales(3 * count), v_opacities(count), v_colors(3 * count);
    frame.pixels_gradient(background.data(), v_color.data(), v_alpha.data(), v_depth.data(), v_background.data(), 2);
    frame.gaussians_gradient(in, {v_means.data(), v_quats.data(), v_log_scales.data(), v_opacities.data(), v_colors.data(), nullptr}, 2);
    write("v_background", v_background), write("v_means", v_means), write("v_quats", v_quats), write("v_log_scales", v_log_scales);
    write("v_opacities", v_opacities), write("v_colors", v_colors);

    const auto comparison = [&](const std::string& name, const std::vector<R>& target) {
        std::vector<R> gradient(3 * pixels);
        const auto mean = graings::compare<R>(height, width, color.data(), target.data(), {-0.2, 0.8, 10}, gradient.data(), 2);
        write((name + "_likeness").c_str(), std::vector<R>{R(mean.similarity), R(mean.absolute), R(mean.squared)});
        write((name + "_v_image").c_str(), gradient);
    };
    const auto other = from.many<R>(3 * pixels, 0, 1);
    comparison("other", other);
    std::vector<R> partly = color;  // differs in a slanted stripe: in another range of each row, and in some rows not at all
    for (int64_t i = 0; i < pixels; i++)
        if (const int64_t x = i % width, y = i / width; y > 20 && y < 90 && (x + 2 * y) % 97 < 3)
            for (int64_t c = 3 * i; c < 3 * i + 3; c++) partly[size_t(c)] = other[size_t(c)];
    comparison("partly", partly);
}

template <class R>
void networks() {
    constexpr int64_t rows = 333;
    const std::vector<int64_t> widths{39, 70, 128, 10};
    Numbers from;
    graings::Network<R> network;
    network.widths = widths;
    std::vector<std::vector<R>> weights, biases, v_weights, v_biases;
    for (size_t l = 0; l + 1 < widths.size(); l++) {
        weights.push_back(from.many<R>(size_t(widths[l] * widths[l + 1]), -0.2, 0.2)), biases.push_back(from.many<R>(size_t(widths[l + 1]), -0.2, 0.2));
        v_weights.emplace_back(weights[l].size()), v_biases.emplace_back(biases[l].size());
    }
    std::vector<R*> to_weights, to_biases;
    for (size_t l = 0; l < weights.size(); l++) {
        network.weights.push_back(weights[l].data()), network.biases.push_back(biases[l].data());
        to_weights.push_back(v_weights[l].data()), to_biases.push_back(v_biases[l].data());
    }
    const auto places = from.many<R>(3 * rows, -1, 1);
    std::vector<R> input(size_t(39 * rows)), output(size_t(10 * rows)), hidden(size_t(graings::hidden_size(widths, rows, graings::kAsStored))), v_input(input.size());
    graings::encode<R>(rows, 3, 6, places.data(), input.data(), 2);
    std::vector<R> harmonics(size_t(30 * rows)), v_normals(places.size());
    const auto normals = from.many<R>(3 * rows, -2, 2), v_harmonics = from.many<R>(30 * rows, -1, 1);
    graings::encode_directions<R>(rows, 3, places.data(), normals.data(), harmonics.data(), 2);
    graings::encode_directions_gradient<R>(rows, 3, places.data(), normals.data(), v_harmonics.data(), v_normals.data(), 2);
    write("harmonics", harmonics), write("v_normals", v_normals);
    graings::evaluate<R>(network, rows, input.data(), output.data(), hidden.data(), graings::kAsStored, 2);
    write("encoded", input), write("network", output);
    const auto upstream = from.many<R>(10 * rows, -1, 1);
    graings::differentiate<R>(network, rows, input.data(), hidden.data(), upstream.data(), v_input.data(), to_weights, to_biases, nullptr, graings::kAsStored, 2);
    write("v_input", v_input);
    for (size_t l = 0; l < weights.size(); l++) write(("v_weight" + std::to_string(l)).c_str(), v_weights[l]), write(("v_bias" + std::to_string(l)).c_str(), v_biases[l]);
}

template <class R>
void children() {
    constexpr int64_t anchors = 60, slots = 10, drawn = anchors * slots, times = 2;
    Numbers from;
    const auto position = from.many<R>(3 * anchors, -1, 1), log_scale = from.many<R>(3 * anchors, -4, -2), offset = from.many<R>(3 * drawn, -1, 1);
    std::vector<int64_t> numbers(drawn);
    for (int64_t i = 0; i < drawn; i++) numbers[size_t(i)] = i;
    std::vector<R> row(size_t(drawn * (3 + slots))), centre(3 * drawn), base(3 * drawn), mean(3 * drawn * times), quat(4 * drawn * times), size(3 * drawn * times),
        shift(3 * drawn * times);
    graings::gather<R>({anchors, slots, position.data(), log_scale.data(), offset.data()}, drawn, numbers.data(), row.data(), centre.data(), base.data(), 2);
    const auto canonical = from.many<R>(7 * drawn, -0.5, 0.5), deformation = from.many<R>(10 * drawn * times, -0.5, 0.5);
    const graings::NetworkOutputs<R> outputs{drawn, times, canonical.data(), base.data(), centre.data(), deformation.data(), 1.5, {0.3, -8, 0, true}};
    graings::compose<R>(outputs, mean.data(), quat.data(), size.data(), shift.data(), 2);
    write("centre", centre), write("mean", mean), write("quat", quat), write("log_scale", size), write("shift", shift);
    const auto v_mean = from.many<R>(3 * drawn, -1, 1), v_quat = from.many<R>(4 * drawn, -1, 1), v_size = from.many<R>(3 * drawn, -1, 1);
    std::vector<R> v_canonical(7 * drawn), v_base(3 * drawn), v_centre(3 * drawn), v_deformation(10 * drawn * times), v_log_scale(3 * anchors), v_offset(3 * drawn);
    const graings::GeometryGradients<R> upstream{{v_mean.data(), nullptr}, {v_quat.data(), v_quat.data()}, {v_size.data(), nullptr}, {nullptr, v_mean.data()}};
    graings::compose_gradient<R>(outputs, upstream, v_canonical.data(), v_base.data(), v_centre.data(), v_deformation.data(), 2);
    graings::gather_gradient<R>({anchors, slots, position.data(), log_scale.data(), offset.data()}, drawn, numbers.data(), row.data(), v_centre.data(), v_base.data(), v_log_scale.data(), v_offset.data(), 2);
    write("v_canonical", v_canonical), write("v_deformation", v_deformation), write("v_log_scale", v_log_scale), write("v_offset", v_offset);
}

}  // namespace

int main() {
    images<float>(), networks<float>(), children<float>();
    images<double>(), networks<double>(), children<double>();
}
