"""Declares what this package offers; imports nothing but gapcert."""
