"""Sums of products and expressions on route dominate: what they enclose, what verification accepts, and what it finds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from certified import certified_waves
from forging import edit_arrays, edit_json, failed

import gapcert as gc
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling
from gapcert.contracts.gaps.gap import FitRoute
from gapcert.numerics.intervals import Interval
from gapcert_bounds.families.basis import Basis, parse
from gapcert_functions.sums import WeightedSum, term
from gapcert_verify.verify import verify_run

NAMES = ("x0", "x1", "u0")
FUNCTIONS = ("1", "x0", "x1^2", "sin(2*x0)", "cos(2*x1)", "abs(u0)*x0", "exp(-x0^2)", "tanh(2*x1 + u0)")
FUNCTION = "the stored function is the one that samples and constants give"
MARGIN = "the margin covers the cover's radius"


def summed(seed: int = 0) -> WeightedSum:
    weights = np.random.default_rng(seed).standard_normal((2, len(FUNCTIONS)))
    return WeightedSum(tuple(parse(t, NAMES) for t in FUNCTIONS), weights)


def test_encloses_its_values_and_its_slopes() -> None:
    q, rng = summed(), np.random.default_rng(1)
    low = rng.uniform(-1, 1, (300, 3))
    boxes = Interval(low, low + rng.uniform(0, 0.5, low.shape))
    over, tight, slopes = q.over(boxes), q.tight_over(boxes), [q.gradient_over(boxes, i) for i in range(2)]
    step = 1e-6
    for _ in range(10):
        z = boxes.lo + rng.random(low.shape) * (boxes.hi - boxes.lo)
        value = q(z)
        assert (over.contains(value) & (tight.lo - 1e-13 <= value) & (value <= tight.hi + 1e-13)).all()
        for j in range(3):
            moved = np.minimum(z + np.eye(3)[j] * step, boxes.hi)
            change = q(moved) - value
            for i, slope in enumerate(slopes):
                way = moved[:, j] - z[:, j]
                assert (slope.lo[:, j] * way - 1e-12 <= change[:, i]).all()
                assert (change[:, i] <= slope.hi[:, j] * way + 1e-12).all()


def test_is_made_again_from_its_data() -> None:
    q = summed()
    again = WeightedSum.stored(json.loads(json.dumps(q.data())), q.arrays())
    z = np.random.default_rng(2).uniform(-1, 1, (50, 3))
    assert again(z).tobytes() == q(z).tobytes()


@pytest.mark.parametrize("data", [[[0, "sinh", 1.0]], [[0, "power", 1.5]], [[0, "abs", 0]], [[-1, "sin", 1.0]]])
def test_no_factor_is_made_of_what_is_none(data: list[object]) -> None:
    with pytest.raises(ValueError, match="is no"):
        term(data)


def certified(folder: Path, route: FitRoute) -> gc.Certificate:
    sampling = GridSampling((9, 9, 9)) if route == "theorem1" else AdaptiveSampling(400)
    return certified_waves(folder, Basis(FUNCTIONS, cells=(2, 2, 2)), sampling, route)


@pytest.mark.exam
@pytest.mark.parametrize("route", Basis.routes)
def test_a_saved_one_is_proved_again(tmp_path: Path, route: FitRoute) -> None:
    assert certified(tmp_path, route).holds
    found = verify_run(tmp_path)
    assert found["verdict"] == "holds", [c for c in found["checks"] if not c["passed"]]


def failing(folder: Path, arrays: dict[str, float], texts: dict[str, str]) -> list[str]:
    """The checks that fail once arrays are scaled and the stored text is replaced, the digest with them."""

    def replaced(form: dict[str, object]) -> object:
        text = json.dumps(form)
        for old, new in texts.items():
            assert old in text
            text = text.replace(old, new)
        return json.loads(text)

    edit_json(folder, form=replaced)
    edit_arrays(folder, **{name: lambda a, by=by: a * by for name, by in arrays.items()})
    return failed(folder)


@pytest.mark.exam
@pytest.mark.parametrize(
    ("arrays", "texts"),
    [
        ({"gap.upper.weights": 0.9}, {}),
        ({"gap.lower.weights": 0.9}, {}),
        ({}, {'"exp"': '"tanh"'}),
        ({}, {'"sin", 2.0': '"sin", 3.0'}),
        ({}, {'["axis", 1]': '["log", ["axis", 1]]'}),
        ({}, {'"exp"': '"sinh"'}),
    ],
    ids=["upper", "lower", "function", "factor", "undefined", "unknown"],
)
def test_forged_functions_are_found(tmp_path: Path, arrays: dict[str, float], texts: dict[str, str]) -> None:
    certified(tmp_path, "dominate")
    assert FUNCTION in failing(tmp_path, arrays, texts)


@pytest.mark.parametrize("texts", [{"2.0": "20.0"}, {'["axis", 1]': '["log", ["axis", 1]]'}], ids=["steeper", "undefined"])
def test_a_forged_slope_is_found(tmp_path: Path, texts: dict[str, str]) -> None:
    certified(tmp_path, "theorem1")
    assert MARGIN in failing(tmp_path, {}, texts)
