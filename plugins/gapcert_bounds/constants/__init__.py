"""Constants: estimated, proved, declared, and per cell."""
