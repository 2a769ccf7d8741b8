"""One moment of a log: synchronized frames and sweeps become measurements of objects in the map frame."""
