"""Export: a trained scene at one time as static splats, in the formats of common tools."""
