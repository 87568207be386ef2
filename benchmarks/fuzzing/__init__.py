"""Hostile input for the readers: seeds, mutations, and the process that reads them (benchmarks/fuzz.py)."""
