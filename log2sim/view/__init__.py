"""Scenarios as one page that a browser plays, with nothing from outside."""

from log2sim.view.page import write_page

__all__ = ["write_page"]
