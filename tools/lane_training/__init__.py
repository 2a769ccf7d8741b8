"""What the network that finds paint on roads is trained with."""
