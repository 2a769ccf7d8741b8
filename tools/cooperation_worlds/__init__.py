"""Random variants of the three tests of vehicle-road cooperation, and what both ends make of them."""
