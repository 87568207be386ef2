"""Thin HTTP over jobs and models. Never trains."""
