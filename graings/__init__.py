"""GrainGS: dynamic 3D Gaussian splatting on a CPU."""

__version__ = "0.1.0"
