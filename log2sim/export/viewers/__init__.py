"""Export to viewers: Foxglove's messages and Rerun's recordings."""
