"""Numbers that define the picture, each with its reason.

Knows nothing of tensors, files or users: what a user may tune lives in `graings.config`.
The kernel and its oracle both receive these as arguments of the call, so they cannot disagree.
"""

from typing import Final

# A contribution below one 8-bit grey level cannot be seen; every public rasterizer cuts here.
ALPHA_MIN: Final = 1.0 / 255.0

# A pixel stops once less than this much light gets through: at most 1e-4 of a colour is lost,
# because the Gaussian that crosses the line is still blended (inclusive stop).
TRANSMITTANCE_MIN: Final = 1e-4

# Upper bound of one Gaussian's alpha (below Eq. c_final of the paper).
ALPHA_MAX: Final = 0.99

# Variance in px^2 added to both image axes: the low-pass that keeps edge-on discs drawable (3DGS). A trained scene
# brings its own, `scene.blur`.
BLUR: Final = 0.3

# Near plane in normalised units (the scene is about 1 across), never an absolute length.
NEAR: Final = 0.01

# A Gaussian farther away or larger than this is counted as non-finite: its gradients would leave float32.
FAR: Final = 1e30

# x/z and y/z are clamped to the image border plus this share of the half field of view before the
# Jacobian is taken: the affine approximation of the projection has no meaning far outside (3DGS).
FRUSTUM_MARGIN: Final = 0.3

# Edge of a square raster tile in pixels: 256 pixels are sixteen 4x4 blocks of one AVX-512 register.
TILE: Final = 16

# Longest side in px of any image that is read or rendered: a larger number is a typo or an attack on memory.
MAX_IMAGE_SIDE: Final = 16384
