"""Vehicle models, their parameters, and the choice of a model for each vehicle."""
