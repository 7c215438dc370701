"""How a named check fails."""

from __future__ import annotations


def expect(holds: bool, message: str) -> None:
    """AssertionError with the message: a statement `assert` would vanish under -O, and pytest rewrites only its own modules."""
    if not holds:
        raise AssertionError(message)
