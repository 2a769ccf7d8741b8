"""Fits of the method's constants, run by `tools/fit.py`."""
