"""The program of one step, and the tube in it."""
