"""A grid, and where its cells may go."""
