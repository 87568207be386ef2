"""The scenes of the suite, one module each: `build(seed)` returns its world."""
