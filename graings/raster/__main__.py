"""`python -m graings.raster` prints which instruction set draws and which others this CPU could run."""

from __future__ import annotations

from graings.kernel import active_isa, available_isas

if __name__ == "__main__":
    print(f"{active_isa()} (available: {', '.join(available_isas())})")
