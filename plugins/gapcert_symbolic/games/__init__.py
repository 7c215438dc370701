"""Goals as games on cells."""
