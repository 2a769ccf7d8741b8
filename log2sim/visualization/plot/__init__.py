"""Pictures of scenarios, and of boxes and points on camera images. Matplotlib's objects only, so no global state."""

from log2sim.visualization.plot.overlay import draw_overlay
from log2sim.visualization.plot.tracks import plot_tracks

__all__ = ["draw_overlay", "plot_tracks"]
