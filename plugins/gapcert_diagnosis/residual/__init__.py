"""What is left, and whether it is noise."""
