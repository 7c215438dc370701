"""Goals, and what makes controllers that reach them."""
