"""A run folder beside its certificate: the spec that it came from, its summary, its pictures and its page."""
