"""Bounds of a residual, what they rest on, and what is claimed of them."""
