"""Columns of the number tables that the compiled motion reads: per coordinate, per input, per output."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from gapcert.numerics.kernels import compiler

Array = npt.NDArray[Any]

# Without reference counts: counting the array arguments of small functions would take most of the time.
# Without Numba it is the same, a hundred times slower.
compiled = compiler(error_model="numpy", _nrt=False)

# Per coordinate.
VISCOUS_UP, VISCOUS_DOWN, QUADRATIC, SPRING, CUBIC, CONSTANT = range(6)
COGGING, COGGING_FREQUENCY, COGGING_PHASE = range(6, 9)
DRY_UP, DRY_DOWN, STATIC, STRIBECK_SPEED, LOAD = range(9, 14)
DAHL, DAHL_STIFFNESS = 14, 15
LUGRE, LUGRE_STATIC, LUGRE_SPEED, LUGRE_STIFFNESS, LUGRE_DAMPING = range(16, 21)
PLAY, PUSH, PUSH_TIME, PUSH_DURATION, TILT, PAYLOAD, COUPLING, PARTNER, SLIP = range(21, 30)
COORDINATE = 30

# Per input.
DELAY, DEAD_ZONE, RATE, LAG, SAG, SAG_TIME, GAIN, OFFSET, SATURATION, LAG_RATE = range(10)
SQUARE, CUBE, FOLLOWED = range(10, 13)
INPUT = 13

# Per output.
BIAS, SCALE, LATE, QUANTUM = range(4)
OUTPUT = 4

# Rows of the workspace, one column per coordinate; a trial state is two rows: positions, velocities.
NOW, SPEED, NEXT, NEXT_SPEED, PULL, NEXT_PULL, FORCE, BIASED, LOADED, NET, MODE, PLAYED, BRISTLE, LUGRE_BRISTLE = range(14)
WORKSPACE = 14
