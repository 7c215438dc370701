"""Texts: read, checked, and printed again."""
