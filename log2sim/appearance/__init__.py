"""Colors of agents."""
