"""Numbers that define the rendered image and the image measures, each with its reason.

What a user may tune lives in `graings.config`. The kernel and its slow reference receive the rasterizer's numbers as
arguments of the call, so they cannot differ; those of SSIM are compiled in and compared by a test.
"""

from typing import Final

# A contribution below one 8-bit grey level cannot be seen; every public rasterizer cuts here.
ALPHA_MIN: Final = 1.0 / 255.0

# A pixel stops once its transmittance falls below this. The Gaussian that crosses the threshold is still blended
# (inclusive stop), so at most 1e-4 of a colour is missing.
TRANSMITTANCE_MIN: Final = 1e-4

# Upper bound of one Gaussian's alpha (below Eq. c_final of the paper).
ALPHA_MAX: Final = 0.99

# Low-pass filter: variance in px^2 added to both image axes, which keeps Gaussians seen edge-on drawable (3DGS).
# A trained scene brings its own, `scene.blur`.
BLUR: Final = 0.3

# Near plane in normalised units (the scene is about 1 across), never an absolute length.
NEAR: Final = 0.01

# A Gaussian farther away or larger than this is counted as non-finite: its gradients would leave float32.
FAR: Final = 1e30

# x/z and y/z are clamped to the image border plus this share of half the field of view before the Jacobian is
# taken: the affine approximation of the projection does not hold far outside the image (3DGS).
FRUSTUM_MARGIN: Final = 0.3

# Edge of a square raster tile in pixels: 256 pixels are sixteen 4x4 blocks of one AVX-512 register.
TILE: Final = 16

# Longest side in px of any image that is read or rendered: a larger number is a typo or an attack on memory.
MAX_IMAGE_SIDE: Final = 16384

# A file of a few kilobytes can declare any size: images with more pixels are refused before they are decoded.
MAX_IMAGE_PIXELS: Final = 2**26  # 1 GB as RGBA float32

# SSIM as 3D Gaussian Splatting defines it, for values in [0, 1]: Gaussian window in pixels and the two stabilisers.
SSIM_WINDOW: Final = 11
SSIM_SIGMA: Final = 1.5
SSIM_C1: Final = 0.01**2
SSIM_C2: Final = 0.03**2
