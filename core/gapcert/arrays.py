"""What arrays hold."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Real numbers."""
Bools = npt.NDArray[np.bool_]
"""Truth values."""
Ints = npt.NDArray[np.int64]
"""Whole numbers."""
