"""The interfaces that a plugin author reads."""
