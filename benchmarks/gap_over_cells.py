"""How far each family's bound of its band over a cell lies beyond what the band takes in it, and what it costs per cell.

Cells are random, of width η along each of the three axes of [−1, 1]³ (two states, one input), on which every family is fitted to
the same smooth residual. The truth is searched for: corners, random points, and steps of falling size from the best of them. The
last row is a network alone (4-400-1, values of 0.1 to 0.3), for which the ranges of its layers (`Network.over`), and a Lipschitz
constant times the cell's radius, are given as well.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

import gapcert as gc
from gapcert.testing.bounds import families_over, searched

ETAS = (0.2, 0.1, 0.05)
NETWORK_ETAS = (0.05, 0.025, 0.01)
