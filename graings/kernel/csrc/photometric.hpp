// SSIM, absolute and squared difference of two images, and the gradient of their weighted sum.
#pragma once
#include <cstdint>

namespace graings {

struct PhotometricTerms {
    double similarity, absolute, squared;  // means over pixels and channels
};

// Mean structural similarity, mean absolute and mean squared difference of two [height, width, 3] images. `gradient`,
// which may be null, is that of their sum weighted by `weights`.
template <class R>
PhotometricTerms compare(int64_t height, int64_t width, const R* image, const R* target, PhotometricTerms weights, R* gradient, int threads);

}  // namespace graings
