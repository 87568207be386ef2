"""Durable training jobs. Knows no HTTP."""
