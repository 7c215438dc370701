"""Normal equations of a motion that runs away."""

from types import SimpleNamespace

import numpy as np

from gapcert_diagnosis.fitting.gauss_newton import Slopes, fall, reduced, steps


def test_equations_that_overflow_make_no_step():
    numbers = SimpleNamespace(value=np.zeros(2), sd=np.ones(2), low=-np.ones(2), high=np.ones(2))
    rng = np.random.default_rng(0)
    r, moved = rng.standard_normal((3, 8, 1)), rng.standard_normal((3, 3, 8, 1))
    here = Slopes.of(np.array([np.inf, 0.5]), np.zeros((3, 1)), r, moved, np.full(3, 1e-3))
    assert all(np.isfinite(a).all() for a in reduced(numbers, here, 1.0, np.array([1e-3, 1.0])))
    assert fall(numbers, here, 1.0) == 0
    sound = Slopes.of(np.array([0.1, 0.5]), np.zeros((3, 1)), r, moved, np.full(3, 1e-3))
    assert np.abs(steps(numbers, sound, 1.0, np.array([1e-3]))[0]).max() > 0
