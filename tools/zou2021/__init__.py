"""The network of Zou et al. (2021): cells and votes of a roadside sensor."""
