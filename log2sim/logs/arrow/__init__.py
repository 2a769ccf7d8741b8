"""Feather and parquet files as NumPy columns, with limits."""
