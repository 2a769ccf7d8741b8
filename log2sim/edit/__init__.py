"""Scenarios with something changed: an agent later, faster, farther left, or gone."""

from log2sim.edit.apply import Edited, edit
from log2sim.edit.edits import Edit, Lateral, Only, Remove, Shift, Speed

__all__ = ["Edit", "Edited", "Lateral", "Only", "Remove", "Shift", "Speed", "edit"]
