"""Recordings with hidden effects from an independent generator, and how hard each of them is to find."""
