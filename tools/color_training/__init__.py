"""Training of the network that names the colors of vehicles."""
