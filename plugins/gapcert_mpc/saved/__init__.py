"""Controllers as files."""
