"""One module per engine: how its pendulum is built, and the loop that it is measured against."""
