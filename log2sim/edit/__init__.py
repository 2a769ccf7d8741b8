"""Scenarios with something changed: an agent later, faster, farther left, or gone."""

from log2sim.edit.edits import Edit, Lateral, Only, Remove, Shift, Speed
from log2sim.edit.run import Edited, edit

__all__ = ["Edit", "Edited", "Lateral", "Only", "Remove", "Shift", "Speed", "edit"]
