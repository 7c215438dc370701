"""Texts as programs, for numbers, intervals and derivatives."""
