"""GrainGS: see a moving scene from anywhere, at any time, with nothing but a CPU."""

__version__ = "0.1.0"
