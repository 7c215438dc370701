"""What every physics engine shares: options, the wiring of a spec's names to a robot, hidden state, tiling."""
