"""Traffic lights and their states."""
