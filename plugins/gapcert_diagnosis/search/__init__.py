"""Which causes: screening, adding, dropping, and what else would do."""
