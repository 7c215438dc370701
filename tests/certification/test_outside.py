"""Asked outside of its set: whatever says γ raises with the axis and its value, or gives NaN in that row and in no other."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Declaration, Interval, Statement
from gapcert.testing.toys import Drift


class Slope(gc.GapFunction):
    """[l, u] of a point alone, so that a row that was exchanged or moved has other numbers."""

    family = "slope"

    def interval(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = z.shape[1] // 2
        return np.sin(3 * z[:, :half]) - 1.5, 2 + np.cos(z[:, half:])

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(np.full((len(boxes), 1), -2.5), np.full((len(boxes), 1), 9.0))

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    @property
    def form(self) -> dict[str, Any]:
        return {"form": "none"}

    def lipschitz(self, boxes: Interval) -> np.ndarray:
        return np.full((len(boxes), 1, boxes.shape[1]), np.inf)


def drawn(seed: int) -> tuple[gc.Domain, np.ndarray]:
    """A domain of one to three states, in every third case with a relation, and points in it, beside it by an ulp, and NaN."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    low = rng.uniform(-3, 1, 2 * n) * 10.0 ** rng.integers(-3, 4, 2 * n)
    high = low + rng.uniform(0.1, 3, 2 * n) * 10.0 ** rng.integers(-3, 4, 2 * n)
    model = Drift(n)
    names = [a.name for a in (*model.states, *model.inputs)]
    cut = [gc.plugin.Relation("a cut", tuple(rng.normal(size=2 * n) / (high - low)), 0.0)] if seed % 3 == 0 else []
    cut = [gc.plugin.Relation(r.text, r.coefficients, float(np.dot(r.coefficients, (low + high) / 2))) for r in cut]
    domain = gc.Domain.of(model, dict(zip(names, zip(low, high, strict=True), strict=True)), cut)
    z = low + (high - low) * rng.random((60, 2 * n))
    for row in range(0, 60, 3):
        j = rng.integers(2 * n)
        ends = (low[j], high[j], np.nextafter(low[j], -np.inf), np.nextafter(high[j], np.inf), np.nan, np.inf, high[j] + 9.0)
        z[row, j] = ends[rng.integers(len(ends))]
    return domain, z


@pytest.mark.parametrize("seed", range(12))
def test_rows_outside_are_nan_and_named_and_the_others_as_if_asked_alone(seed: int) -> None:
    domain, z = drawn(seed)
    x, u = domain.split(z)
    inside = ((z >= domain.low) & (z <= domain.high)).all(axis=1)
    for r in domain.relations:
        inside &= (z * r.coefficients).sum(axis=1) <= r.bound + 1e-12
    said: list[Statement] = [Declaration(Slope(), Drift(domain.nx), domain)]
    said.append(gc.Certified.of(said[0]))
    assert 0 < inside.sum() < len(z)
    for statement in said:
        low, high = statement.interval(x, u, outside="nan")
        gamma = statement.gamma(x, u, outside="nan")
        for values in (low, high, gamma):
            assert np.isnan(values[~inside]).all()
            assert np.isfinite(values[inside]).all()
        alone = Slope().interval(z[inside])
        assert np.array_equal(low[inside], alone[0])
        assert np.array_equal(statement.gamma(x[inside], u[inside]), Slope().gamma(z[inside]))
        row = int(np.argmin(inside))
        left = [j for j in range(z.shape[1]) if not domain.low[j] <= z[row, j] <= domain.high[j]]
        what = f"{domain.axes[left[0]].name} = {z[row, left[0]].item()!r} is outside [" if left else "'a cut' does not hold"
        for ask in (statement.gamma, statement.interval):
            with pytest.raises(gc.UsageError, match=re.escape(f"certificate: row {row}: {what}")):
                ask(x, u)


@pytest.mark.parametrize("seed", range(6))
def test_an_angle_over_a_full_turn_is_asked_on_its_turn_and_a_narrower_one_is_a_number(seed: int) -> None:
    """From −20 to 20 turns on, at both ends of the turn and beside them by an ulp: nothing is outside of it."""
    rng, axes = np.random.default_rng(seed), (gc.StateSpec("theta", "rad", "angle"), gc.StateSpec("w", "rad/s"))
    low = float(rng.uniform(-4, 1))
    ends = (low, low + 2 * np.pi), (low, low + 3.0)
    inputs = gc.Box((gc.StateSpec("u0", "1"), gc.StateSpec("u1", "1")), (-1.0, -1.0), (1.0, 1.0))
    whole, part = (gc.Domain(gc.Box(axes, (a, -2.0), (b, 2.0)), inputs) for a, b in ends)
    own = np.concatenate([rng.uniform(*ends[0], 40), np.nextafter(ends[0], np.inf), np.nextafter(ends[0], -np.inf), ends[0]])
    turns = rng.integers(-20, 21, len(own))
    x, u = np.stack([own + 2 * np.pi * turns, rng.uniform(-2, 2, len(own))], axis=1), rng.uniform(-1, 1, (len(own), 2))
    on = whole.turned(np.hstack([x, u]))
    assert whole.zone.contains(on).all()
    low_, high_ = Declaration(Slope(), Drift(2), whole).interval(x, u)
    assert np.array_equal(np.stack([low_, high_]), np.stack(Slope().interval(on)))
    lost = np.isnan(Declaration(Slope(), Drift(2), part).gamma(x, u, outside="nan")).any(axis=1)
    assert np.array_equal(lost, ~((x[:, 0] >= ends[1][0]) & (x[:, 0] <= ends[1][1])))
    with pytest.raises(gc.UsageError, match=r"w = 2.5 is outside \[-2, 2\] rad/s"):
        Declaration(Slope(), Drift(2), whole).gamma([low + 40.0, 2.5], [0.0, 0.0])


@pytest.mark.run
def test_one_point_is_asked_as_rows_are_and_a_stored_certificate_answers_the_same(tmp_path: Path) -> None:
    model = {"kind": "equations", "states": {"v": "1"}, "inputs": {"u": "1"}, "period": "0.1 s"}
    spec = {
        "version": 1,
        "name": "sled",
        "domain": {"v": [-2, 2], "u": [-1, 1]},
        "report": {"rerun": False, "html": False},
        "model": model | {"next": {"v": "v + 0.1*u"}},
        "backend": model | {"next": {"v": "v - 0.03*v*abs(v) + 0.1*u"}},
    }
    run = gc.run(spec, out=tmp_path)
    stored, far = gc.Certified.load(run.folder), ([[0.5], [2.5], [-1.0]], [[0.0], [0.0], [1.5]])
    assert np.array_equal(np.isnan(stored.gamma(*far, outside="nan")[:, 0]), [False, True, True])
    assert run.certificate.gamma([0.5], [0.1]) == pytest.approx(stored.gamma([0.5], [0.1]))
    assert (np.abs(0.03 * 1.9 * 1.9) <= stored.gamma([1.9], [0.0])).all()
    for statement in (run.certificate, stored):
        with pytest.raises(gc.UsageError, match=r"row 1: v = 2.5 is outside \[-2, 2\], .*; ask inside, or take outside='nan'"):
            statement.gamma(*far)
        assert statement.monitor().step([1.0], [0.0], [0.97]).violated == stored.monitor().step([1.0], [0.0], [0.97]).violated
