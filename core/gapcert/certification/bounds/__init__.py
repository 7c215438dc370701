"""What constants bound, and what contradicts them."""
