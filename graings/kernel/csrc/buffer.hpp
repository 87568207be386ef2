// An array without initialisation, aligned to a cache line.
#pragma once
#include <algorithm>
#include <cstdlib>
#include <memory>
#include <new>

namespace graings {

template <class T>
class Buffer {
public:
    Buffer() = default;
    explicit Buffer(size_t count) {
        const size_t bytes = (std::max<size_t>(count, 1) * sizeof(T) + 63) / 64 * 64;
        data_.reset(static_cast<T*>(std::aligned_alloc(64, bytes)));
        if (!data_) throw std::bad_alloc();
    }
    T* get() const { return data_.get(); }
    T& operator[](size_t i) const { return data_.get()[i]; }

private:
    struct Free { void operator()(void* p) const { std::free(p); } };
    std::unique_ptr<T, Free> data_;
};

}  // namespace graings
