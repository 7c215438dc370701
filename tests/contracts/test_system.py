"""What System promises for every subclass: checked arguments, the geometry of differences, rollouts, digests."""

import os
import pickle
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Parameter, StateSpec, System, UsageError, load_spec
from gapcert.plugin import Step, difference
from gapcert.testing import ToyOscillator
from gapcert.testing.toys import Drift

REAL, ANGLE, QUATERNION = StateSpec("x", "m"), StateSpec("a", "rad", "angle"), StateSpec("q", "1", "quaternion")
angles = st.floats(-50, 50)
vectors = st.tuples(*[st.floats(-3, 3)] * 3)


def quaternion(vector):
    """exp of half a rotation vector: (w, x, y, z)."""
    v = np.asarray(vector, dtype=float)
    half = np.linalg.norm(v) / 2
    return np.concatenate([[np.cos(half)], v / 2 * np.sinc(half / np.pi)])


def matrix(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(angles, angles)
def test_angle_difference_is_the_short_way_round(a, b):
    d = float(ANGLE.difference(np.array(a), np.array(b)))
    assert abs(d) <= np.pi * (1 + 1e-15)
    assert np.exp(1j * (b + d)) == pytest.approx(np.exp(1j * a), abs=1e-13)
    assert float(ANGLE.difference(np.array(b), np.array(a))) == -d


@given(angles, st.floats(-3.1, 3.1))
def test_angle_difference_keeps_every_bit_of_a_short_way(a, d):
    b = a + d
    assert float(ANGLE.difference(np.array(b), np.array(a))) == b - a


@given(angles, st.integers(-4, 4))
def test_angle_difference_ignores_whole_turns(a, k):
    assert float(ANGLE.difference(np.array(a + 2 * np.pi * k), np.array(a))) == pytest.approx(0, abs=1e-13)


@given(vectors, vectors)
def test_quaternion_difference_rotates_b_onto_a(u, v):
    a, b = quaternion(u), quaternion(v)
    d = QUATERNION.difference(a, b)
    assert d.shape == (3,)
    assert np.linalg.norm(d) <= np.pi + 1e-12
    assert matrix(quaternion(d)) @ matrix(b) == pytest.approx(matrix(a), abs=1e-12)


@given(vectors, vectors)
def test_quaternion_difference_does_not_see_the_sign(u, v):
    a, b = quaternion(u), quaternion(v)
    if abs(a @ b) > 1e-6:  # half a turn apart, both ways round are equally short
        assert QUATERNION.difference(-a, b) == pytest.approx(QUATERNION.difference(a, b), abs=1e-8)


@given(vectors)
def test_quaternion_difference_of_equals_is_zero(v):
    assert QUATERNION.difference(quaternion(v), quaternion(v)) == pytest.approx(np.zeros(3), abs=1e-15)


@given(st.floats(1e-12, 1e-3))
def test_small_rotations_keep_their_relative_precision(angle):
    d = QUATERNION.difference(quaternion([0, 0, angle]), quaternion([0, 0, 0]))
    assert d == pytest.approx([0, 0, angle], rel=1e-12)


def test_difference_of_mixed_columns():
    specs = (REAL, ANGLE, QUATERNION, REAL)
    a = np.array([[1.0, 3.1, *quaternion([0.1, 0, 0]), 5.0]] * 2)
    b = np.array([[0.5, -3.1, 1, 0, 0, 0, 7.0]] * 2)
    d = difference(specs, a, b)
    assert d.shape == (2, 6)
    assert d[0] == pytest.approx([0.5, 6.2 - 2 * np.pi, 0.1, 0, 0, -2.0])
    assert (difference((REAL, REAL), a[:, :2], b[:, :2]) == a[:, :2] - b[:, :2]).all()


X, U = np.zeros((3, 2)), np.zeros((3, 1))
BAD = {
    "rows of x and u": ((X, U[:2]), {}, "one input per state"),
    "columns of x": ((np.zeros((3, 1)), U), {}, r"expected \(n, 2\)"),
    "x flat": ((np.zeros(2), U), {}, r"expected \(n, 2\)"),
    "nan": ((np.full((3, 2), np.nan), U), {}, "is not finite"),
    "infinite": ((X, np.full((3, 1), np.inf)), {}, "is not finite"),
    "columns of hidden": ((X, U), {"hidden": np.zeros((3, 2))}, "hidden has shape"),
    "rows of hidden": ((X, U), {"hidden": np.zeros((2, 1))}, "one per row"),
    "forces": ((X, U), {"forces": np.zeros((3, 1, 1))}, "forces of shape"),
    "parameter": ((X, U), {"parameters": {"q": 1.0}}, "no parameter 'q'"),
    "nan parameter": ((X, U), {"parameters": {"k": np.nan}}, "parameter k"),
    "rows of a parameter": ((X, U), {"parameters": {"k": np.ones(2)}}, "one per row"),
    "seed": ((X, U), {"seed": 1}, "option 'seed' is not declared"),
}


@pytest.mark.parametrize("case", BAD, ids=list(BAD))
def test_bad_arguments_are_refused_in_one_sentence(case):
    arguments, options, message = BAD[case]
    with pytest.raises(UsageError, match=message) as error:
        ToyOscillator().step(*arguments, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("sequence", "options", "message"),
    [
        (np.zeros((3, 4)), {}, r"expected \(3, T, 1\)"),
        (np.zeros((2, 4, 1)), {}, r"expected \(3, T, 1\)"),
        (np.full((3, 4, 1), np.nan), {}, "not finite"),
        (np.zeros((3, 4, 1)), {"forces": np.zeros((3, 3, 2, 1))}, r"expected \(3, 4, 2, 1\)"),
    ],
)
def test_bad_rollouts_are_refused(sequence, options, message):
    with pytest.raises(UsageError, match=message):
        ToyOscillator().rollout(X, sequence, **options)


def test_rollout_of_no_step_is_its_start():
    out = ToyOscillator().rollout(X + 1, np.zeros((3, 0, 1)))
    assert (out.x == (X + 1)[:, None]).all()


def test_seeded_rollout_draws_anew_each_step():
    toy = ToyOscillator(noise=0.1)
    x = toy.rollout(X, np.zeros((3, 50, 1)), parameters={"k": 0.0}, seed=3).x
    jumps = np.diff(x[:, :, 1], axis=1)
    assert np.unique(jumps).size == jumps.size
    assert np.array_equal(x, toy.rollout(X, np.zeros((3, 50, 1)), parameters={"k": 0.0}, seed=3).x)


def test_default_resolution_is_four_ulp():
    e = ToyOscillator().resolution(np.array([1.0, 0.0]))
    assert e[0] == 4 * np.finfo(float).eps
    assert 0 < e[1] < 1e-300


class Holder(System):
    """A System whose attribute `held` takes part in its digest."""

    def __init__(self, held):
        self.states, self.inputs, self.period, self.held = (REAL,), (), 1.0, held

    def _step(self, x, u, **options):
        return Step(x)


HELD = [
    0.1,
    0.1 + 2**-56,
    1,
    "a",
    ("a", "b"),
    ("b", "a"),
    {"a": 1, "b": 2.0},
    {"a": 2.0, "b": 1},
    frozenset("abc"),
    frozenset("abd"),
    np.arange(3.0),
    np.arange(3),
    np.arange(3.0).reshape(1, 3),
    Parameter("a", 1.0),
    Parameter("a", 1.0, "m"),
    np.float64(7),
    partial(max, 1),
    partial(max, 2),
    partial(min, 1),
    range(3),
]


def test_digest_separates_what_differs():
    assert len({Holder(h).digest() for h in HELD}) == len(HELD)


def test_digest_covers_attributes_and_no_code():
    one, other = (type("Law", (), {"__module__": "m", "__qualname__": "Law", "__call__": f}) for f in (abs, min))
    assert Holder(one).digest() == Holder(other).digest()  # the name alone


def test_no_digest_is_a_sentence():
    turned = Holder(None)
    turned.held = turned._step
    with pytest.raises(UsageError, match=r"Holder: no digest \(an attribute leads back to it\); .*; leave it out, or override"):
        turned.digest()
    with pytest.raises(UsageError, match=r"Holder: no digest \(cannot pickle .*lock"):
        Holder(threading.Lock()).digest()


@pytest.mark.parametrize("held", HELD, ids=range(len(HELD)))
def test_digest_survives_pickling(held):
    assert pickle.loads(pickle.dumps(Holder(held))).digest() == Holder(held).digest()


@pytest.mark.contract
def test_digest_is_the_same_in_every_process():
    code = "from gapcert.testing import ToyOscillator; print(ToyOscillator().digest())"
    seen = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert seen == {f"{ToyOscillator().digest()}\n".encode()}


def test_a_toy_s_spec_is_that_toy():
    toy = Drift(2, 0.3)
    again = load_spec({"version": 1, "name": "toy", "model": toy.to_spec()}).build("model")
    assert (again.states, again.inputs, again.period) == (toy.states, toy.inputs, toy.period)
    x, u = np.random.default_rng(0).normal(size=(2, 50, 2))
    assert np.array_equal(again.step(x, u).x, toy.step(x, u).x)


@settings(max_examples=20)
@given(st.integers(1, 6), st.integers(0, 2**32))
def test_rollout_equals_steps_bit_for_bit(steps, seed):
    rng, toy = np.random.default_rng(seed), ToyOscillator()
    x0, u, forces = rng.normal(size=(2, 2)), rng.normal(size=(2, steps, 1)), rng.normal(size=(2, steps, 2, 1))
    out, here = toy.rollout(x0, u, forces=forces), Step(x0, None)
    for k in range(steps):
        here = toy.step(here.x, u[:, k], hidden=here.hidden, forces=forces[:, k])
        assert out.x[:, k + 1].tobytes() == here.x.tobytes()
    assert out.hidden.tobytes() == here.hidden.tobytes()


@given(st.lists(st.tuples(angles, angles, angles, angles), min_size=1, max_size=5))
def test_differences_of_columns_are_those_of_each(rows):
    specs, pairs = (ANGLE, REAL, ANGLE), np.array(rows)
    a, b = pairs[:, [0, 1, 2]], pairs[:, [3, 2, 1]]
    each = np.stack([s.difference(a[:, i], b[:, i]) for i, s in enumerate(specs)], axis=1)
    np.testing.assert_array_equal(difference(specs, a, b), each)
    assert np.isnan(difference(specs, a * np.nan, b)).all()
    assert difference(specs, a[:0], b[:0]).shape == (0, 3)
