// An uninitialised array, aligned to a cache line.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <memory>
#include <new>

namespace graings {

inline size_t whole_lines(size_t bytes) { return (bytes + 63) / 64 * 64; }

template <class T>
class Buffer {
public:
    Buffer() = default;
    explicit Buffer(size_t count) {
        data_.reset(static_cast<T*>(std::aligned_alloc(64, whole_lines(std::max<size_t>(count, 1) * sizeof(T)))));
        if (!data_) throw std::bad_alloc();
    }
    T* get() const { return data_.get(); }
    T& operator[](size_t i) const { return data_.get()[i]; }

private:
    struct Free { void operator()(void* p) const { std::free(p); } };
    std::unique_ptr<T, Free> data_;
};

}  // namespace graings
