"""Roads along the paths of agents, as OpenDRIVE and as lanes of other formats."""
