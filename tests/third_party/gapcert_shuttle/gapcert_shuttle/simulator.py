"""A simulator as one finds it: an object that remembers, ticks, and knows nothing of batches."""


class Shuttle:
    """A carriage (2 kg) under a force; in its slot of ±2 cm slides a block (1 kg) that bounces off rubber ends.

    The rubber has memory: its force follows the compression with a lag, so the last tick's force is part of the state.
    """

    TICK, SLOT, STIFFNESS, DAMPING, LAG, FRICTION = 5e-4, 0.02, 4e3, 8.0, 0.3, 0.2

    def __init__(self):
        self.position = self.velocity = self.block = self.block_velocity = self.rubber = 0.0

    def tick(self, force, block_force=0.0):
        """Half a millisecond. `block` is the block's place in the slot, in the carriage's frame."""
        over = max(self.block - self.SLOT, 0.0) + min(self.block + self.SLOT, 0.0)
        relative = self.block_velocity - self.velocity
        push = -self.STIFFNESS * over - (self.DAMPING * relative if over else 0.0)
        self.rubber += self.LAG * (push - self.rubber)
        drag = -self.FRICTION * relative / (0.01 + abs(relative))
        on_block = self.rubber + drag + block_force
        self.velocity += self.TICK * (force - self.rubber - drag) / 2.0
        self.block_velocity += self.TICK * on_block / 1.0
        self.position += self.TICK * self.velocity
        self.block += self.TICK * (self.block_velocity - self.velocity)
