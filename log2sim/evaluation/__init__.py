"""Comparison with truth: metrics of one scenario, and benchmarks over methods and settings."""
