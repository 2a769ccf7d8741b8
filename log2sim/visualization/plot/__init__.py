"""Pictures of scenarios. They use no global state of Matplotlib."""

from log2sim.visualization.plot.tracks import plot_tracks

__all__ = ["plot_tracks"]
