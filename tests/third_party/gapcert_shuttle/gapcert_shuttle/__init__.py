"""A carriage with a loose block in its slot, as a backend of Gapcert."""
