// Array arguments of the bindings: checks, and networks of them.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "perceptron.hpp"

namespace nb = nanobind;

template <class T> using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu>;
// An array that the kernel writes. Unlike an input it is never converted to another type: results would go to a copy.
template <class T> struct Out : nb::ndarray<T, nb::c_contig, nb::device::cpu> {};

namespace nanobind::detail {
template <class T> struct type_caster<Out<T>> {
    using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
    NB_TYPE_CASTER(Out<T>, make_caster<Array>::Name)
    bool from_python(handle source, uint8_t flags, cleanup_list* cleanup) noexcept {
        make_caster<Array> array;
        if (!array.from_python(source, uint8_t(flags & ~uint8_t(cast_flags::convert)), cleanup)) return false;
        static_cast<Array&>(value) = std::move(array.value);
        return true;
    }
};
}  // namespace nanobind::detail

template <class Array>
auto* checked(const Array& array, size_t size, const char* name) {
    if (array.size() != size)
        throw std::invalid_argument(std::string(name) + " must have " + std::to_string(size) + " elements, got " + std::to_string(array.size()));
    return array.data();
}
template <class Array>
auto* checked(const std::optional<Array>& array, size_t size, const char* name) {
    return array ? checked(*array, size, name) : nullptr;
}

template <class R>
graings::Network<R> network(const In<R>& input, int64_t rows, const std::vector<In<R>>& weights, const std::vector<In<R>>& biases,
                            const std::optional<In<R>>& shared, const std::optional<In<int64_t>>& group) {
    if (weights.empty() || weights.size() > graings::kMaxLayers || biases.size() != weights.size())
        throw std::invalid_argument("a network has 1 to " + std::to_string(graings::kMaxLayers) + " layers, each with a weight and a bias");
    graings::Network<R> result;
    result.widths.push_back(int64_t(weights[0].shape(1)));
    for (size_t l = 0; l < weights.size(); l++) {
        const size_t out = weights[l].shape(0);
        result.weights.push_back(checked(weights[l], out * size_t(result.widths.back()), "weight"));
        result.biases.push_back(checked(biases[l], out, "bias"));
        result.widths.push_back(int64_t(out));
    }
    checked(input, size_t(rows * result.widths[0]), "input");
    if (!shared) return result;
    if (!group) throw std::invalid_argument("shared needs the group of every row");
    result.groups = int64_t(shared->shape(0));
    result.shared = checked(*shared, size_t(result.groups * result.widths[1]), "shared");
    result.group = checked(*group, size_t(rows), "group");
    return result;
}

// Number of spherical harmonics of degrees 1 to `degree`.
inline size_t harmonics_of(int degree) {
    if (degree < 1 || degree > 3) throw std::invalid_argument("degree must lie in [1, 3]");
    return size_t(degree * (degree + 2));
}
