"""Plugins begun: a working component of any kind, with its contract test and a spec that uses it."""
