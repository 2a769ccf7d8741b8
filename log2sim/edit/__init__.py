"""Edits of scenarios: agents later, faster, in another lane, cutting in, of another category, added or removed."""

from log2sim.edit.apply import Edited, edit
from log2sim.edit.edits import Add, CutIn, DropDoubtful, Edit, Lateral, Only, Remove, Replace, Shift, Speed, Window

__all__ = [
    "Add", "CutIn", "DropDoubtful", "Edit", "Edited", "Lateral", "Only", "Remove", "Replace", "Shift", "Speed",
    "Window", "edit",
]  # fmt: skip
