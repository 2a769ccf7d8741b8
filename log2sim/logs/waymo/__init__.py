"""Waymo Open Dataset: TFRecords of version 1, parquet components of version 2."""
