"""Edits of scenarios: an agent later, faster, shifted sideways, or removed."""

from log2sim.edit.apply import Edited, edit
from log2sim.edit.edits import DropDoubtful, Edit, Lateral, Only, Remove, Shift, Speed

__all__ = ["DropDoubtful", "Edit", "Edited", "Lateral", "Only", "Remove", "Shift", "Speed", "edit"]
