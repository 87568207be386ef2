"""glb_bytes: splats as a binary glTF 2.0 file with the extension KHR_gaussian_splatting (ratified by Khronos).

A mesh of points carries every value as an attribute of its own, in float32. No library writes the extension yet.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np
import torch

import graings
from graings import constants
from graings.camera.units import Units
from graings.scene.splats import Splats

_NAME: Final = "KHR_gaussian_splatting"
_KINDS: Final = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_FLOAT, _ARRAY_BUFFER, _POINTS = 5126, 34962, 0


def glb_bytes(splats: Splats, units: Units) -> bytes:
    """The file of `splats`, which are in the normalised units that `units` describes; it is in the capture's.

    glTF has +y up; a node turns the capture's vertical there, so the coordinates stay those of the capture.
    """
    attributes = {
        "POSITION": units.points_back(splats.means.double().numpy()),
        f"{_NAME}:ROTATION": torch.nn.functional.normalize(splats.quats, dim=-1)[:, [1, 2, 3, 0]].numpy(),
        f"{_NAME}:SCALE": (splats.log_scales.double().exp() / units.scale).numpy(),
        f"{_NAME}:OPACITY": splats.opacities.clamp(0.0, constants.ALPHA_MAX)[:, None].numpy(),
    }
    for degree in range(splats.degree + 1):
        for order in range(2 * degree + 1):
            name = f"{_NAME}:SH_DEGREE_{degree}_COEF_{order}"
            attributes[name] = splats.harmonics[:, degree**2 + order].numpy()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    binary = b""
    for index, (name, values) in enumerate(attributes.items()):
        rows = np.ascontiguousarray(values, dtype="<f4")
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": rows.nbytes, "target": _ARRAY_BUFFER})
        kind = _KINDS[rows.shape[1]]
        accessors.append({"bufferView": index, "componentType": _FLOAT, "count": len(rows), "type": kind})
        if name == "POSITION":
            accessors[-1] |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        binary += rows.tobytes()
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_NAME: extension},
    }
    document = {
        "asset": {"version": "2.0", "generator": f"graings {graings.__version__}"},
        "extensionsUsed": [_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _to_y(np.asarray(units.up))}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _to_y(up: np.ndarray[Any, np.dtype[np.float64]]) -> list[float]:
    """The quaternion (x, y, z, w) of the shortest rotation that takes the unit vector `up` to +y."""
    x, y, z = (float(value) for value in up)
    if y < -1 + 1e-12:
        return [1.0, 0.0, 0.0, 0.0]
    found = np.array([-z, 0.0, x, 1.0 + y])  # (up cross y, 1 + up dot y)
    return [float(value) for value in found / np.linalg.norm(found)]
