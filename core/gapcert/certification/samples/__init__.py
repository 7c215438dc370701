"""Which transitions are asked for, who computes them, and where they are kept."""
