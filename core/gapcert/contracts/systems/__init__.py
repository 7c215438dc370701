"""What steps, where it lives, and what it looks like."""
