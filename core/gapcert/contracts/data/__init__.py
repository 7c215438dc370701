"""Recordings, their units, and the effects that they may show."""
