"""`python -m graings.raster` prints the instruction set in use and those that this CPU can run."""

from __future__ import annotations

from graings.kernel import active_isa, available_isas

if __name__ == "__main__":
    print(f"{active_isa()} (available: {', '.join(available_isas())})")
