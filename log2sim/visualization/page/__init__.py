"""Scenarios as one page that a browser plays, with nothing from outside."""

from log2sim.visualization.page.writer import write_page

__all__ = ["write_page"]
