"""Spec files: read, checked, and made into a typed whole."""
