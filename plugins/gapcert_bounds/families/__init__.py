"""Families of gap functions."""
