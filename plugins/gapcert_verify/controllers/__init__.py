"""Saved controllers proved once more: on cells one by one, and of model predictive ones what they store."""
