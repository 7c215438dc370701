"""Controllers as programs that need no Gapcert."""
