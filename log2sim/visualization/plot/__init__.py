"""Pictures of scenarios. They use no global state of Matplotlib."""
