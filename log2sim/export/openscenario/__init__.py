"""OpenSCENARIO XML: written in three revisions, and read back."""
