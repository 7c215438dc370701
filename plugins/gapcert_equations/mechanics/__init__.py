"""Bodies, joints and contact, and one step in time."""
