"""PandaSet sequences."""
