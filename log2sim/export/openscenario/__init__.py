"""OpenSCENARIO XML: written in three revisions, and imported."""
