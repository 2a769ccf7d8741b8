"""How far an agent can be trusted: the probability that it is right, and the standard deviations of its states."""
