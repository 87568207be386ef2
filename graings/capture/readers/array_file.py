"""read_array: a table of numbers in NumPy's file format."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from graings.capture.folder import CaptureFolder
from graings.errors import CaptureError


def read_array(folder: CaptureFolder, name: str, *, columns: int) -> NDArray[np.float64]:
    """The table [N, `columns`] in the file `name`, without Python objects. Raises `CaptureError` for anything else."""
    try:
        values = np.load(io.BytesIO(folder.read(name)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise CaptureError(f"is no array ({error})", file=name, remedy="Export the capture again.") from error
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.shape[1] != columns or not values.size:
        shape = getattr(values, "shape", None)
        raise CaptureError(
            f"holds {shape}, not (N, {columns}) numbers", file=name, field="shape", remedy="Export the capture again."
        )
    if not np.issubdtype(values.dtype, np.floating) and not np.issubdtype(values.dtype, np.integer):
        raise CaptureError(f"holds {values.dtype}", file=name, field="dtype", remedy="Export the capture again.")
    return values.astype(np.float64)
