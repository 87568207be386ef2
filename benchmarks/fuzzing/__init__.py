"""Hostile input for the readers: seeds, mutations, and the bounded process that reads them. Run by benchmarks/fuzz.py."""
