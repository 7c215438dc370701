"""Parameters fitted over windows, and what a rollout then misses."""
