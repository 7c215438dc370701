"""Robust model predictive control: tubes that take γ(x, u)."""
