"""Checks of records as they are read: pictures and sweeps that are repeated, show nothing, or are missing."""
