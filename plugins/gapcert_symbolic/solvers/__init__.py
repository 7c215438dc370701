"""Fixpoints over windows of cells."""
