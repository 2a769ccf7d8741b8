"""Detection of road users in clouds: grid, network, decoding."""
