"""Simulate light transport once, keep it in Zarr stores, relight in a fraction of a second with a known error."""

__version__ = "0.1.0"
