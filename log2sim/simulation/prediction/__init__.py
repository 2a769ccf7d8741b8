"""Where agents will be within seconds, by what they did so far; and how far such predictions were off."""
