"""What moves agents: vehicle models, their parameters, and which of them a maneuver needs."""
