"""While tests run, shapes are checked: the jaxtyping annotations of the method are enforced by beartype.

Modules that meet callers (readers, rasterizer, metrics) check their arguments themselves and are tested for the
errors they give, which the hook would forestall.
"""

from __future__ import annotations

from jaxtyping import install_import_hook

from tests import shapes

install_import_hook(["graings.scene", "graings.training", "graings.render"], f"{shapes.__name__}.checked")
