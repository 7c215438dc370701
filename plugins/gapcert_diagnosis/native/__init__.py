"""Causes among the engine's own parameters."""
