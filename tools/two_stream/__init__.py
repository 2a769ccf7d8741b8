"""The network of two streams of Chen et al.: the clouds of a vehicle and of the road."""
