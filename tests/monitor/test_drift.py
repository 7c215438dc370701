"""Trends in residuals: unchanged plants are accused as seldom as stated, whatever neighbours share, and drifts are found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from gapcert_monitor import drift as module
from gapcert_monitor.drift import drift
from gapcert_monitor.thresholds import THRESHOLDS

Array = np.ndarray
RARE = 1 - THRESHOLDS.drift_level


def neighbours(n: int, rho: float, rng: np.random.Generator) -> Array:
    """AR(1) of variance 1, from its stationary law."""
    shocks = np.sqrt(1 - rho**2) * rng.normal(size=n)
    return np.asarray(lfilter([1.0], [1.0, -rho], shocks, zi=[rho * rng.normal()])[0])


def visited(n: int, kind: str, rng: np.random.Generator) -> Array:
    """Points of Z along a log: unrelated, or on a path that goes back and forth."""
    if kind == "anywhere":
        return rng.uniform(-1, 1, (n, 2))
    held = np.repeat(rng.uniform(-1, 1, n // 8 + 1), 8)[:n]
    return np.stack([np.sin(np.cumsum(0.06 * rng.normal(size=n))), held], axis=1)


def looped(n: int, rng: np.random.Generator, held: int = 25) -> tuple[Array, Array]:
    """(r, z) of a plant under feedback whose residual is a ripple of its state, and noise that passes through the loop; it goes
    to set-points that are held for so many steps.
    """
    x, goal, r, z = rng.uniform(-0.5, 0.5), 0.0, np.empty(n), np.empty((n, 2))
    slow = 0.05 * neighbours(n, 0.9, rng)
    for k in range(n):
        goal = rng.uniform(-0.8, 0.8) if k % held == 0 else goal
        u = 2 * (goal - x)
        z[k], r[k] = (x, u), 0.02 * np.sin(5 * x) + 0.01 * np.cos(2 * u) + 0.02 * slow[k] + 0.004 * rng.normal()
        x += 0.1 * u + r[k]
    return r, z


def told(r: Array, z: Array, gamma: float) -> bool:
    found = drift(r, np.full(len(r), gamma), z)
    return found is not None and found["trend"]


def accused(logs: int, n: int, rho: float, kind: str, seed: int) -> int:
    rng = np.random.default_rng(seed)
    return sum(told(neighbours(n, rho, rng), visited(n, kind, rng), 1.0) for _ in range(logs))


@pytest.mark.parametrize("rho", [0.0, 0.8, 0.99])
@pytest.mark.parametrize("kind", ["anywhere", "path"])
def test_an_unchanged_plant_is_seldom_accused(rho: float, kind: str) -> None:
    assert accused(150, 160, rho, kind, 1) <= binom.ppf(1 - 1e-4, 150, RARE)


@pytest.mark.exam
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.95, 0.99])
@pytest.mark.parametrize("n", [90, 350, 1500])
@pytest.mark.parametrize("kind", ["anywhere", "path"])
def test_the_level_is_the_one_that_is_stated(rho: float, n: int, kind: str) -> None:
    logs = 2000
    assert accused(logs, n, rho, kind, 2) <= binom.ppf(0.999, logs, RARE)


@pytest.mark.exam
@pytest.mark.parametrize(("n", "held"), [(120, 25), (200, 25), (200, 40), (350, 50), (600, 25)])
def test_so_it_is_in_closed_loops(n: int, held: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def accusations() -> int:
        rng = np.random.default_rng(3)
        return sum(told(*looped(n, rng, held), 0.05) for _ in range(logs))

    logs = 2000
    assert accusations() <= binom.ppf(0.999, logs, RARE)
    if held > 25:  # of few set-points a quadratic function leaves what looks like a trend
        quadratic(monkeypatch)
        assert accusations() > binom.ppf(0.999, logs, RARE)


def quadratic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "THRESHOLDS", replace(THRESHOLDS, drift_degree=2))


def test_a_drift_beside_a_ripple_is_found_in_closed_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, n = np.random.default_rng(8), 600
    logs = [(r + 0.015 * np.linspace(0, 1, n), z) for r, z in (looped(n, rng) for _ in range(20))]
    assert sum(told(r, z, 0.05) for r, z in logs) >= 18
    quadratic(monkeypatch)
    assert sum(told(r, z, 0.05) for r, z in logs) <= 5


def test_without_what_neighbours_share_it_would_cry_wolf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_independent", lambda left, k: float(len(left)))
    assert accused(100, 160, 0.9, "anywhere", 4) <= 3  # the lowest frequencies show as much
    monkeypatch.setattr(module, "_slow", lambda left, known, time: (0.0, 10))
    assert accused(100, 160, 0.9, "anywhere", 4) > 20


def test_a_mixture_of_fast_and_slow_needs_the_lowest_frequencies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neighbours correlate little where white noise covers what is slow."""

    def accusations() -> int:
        rng = np.random.default_rng(5)
        logs = ((rng.normal(size=600) + 0.7 * neighbours(600, 0.97, rng), visited(600, "anywhere", rng)) for _ in range(150))
        return sum(told(r, z, 1.0) for r, z in logs)

    assert accusations() <= 3
    monkeypatch.setattr(module, "_slow", lambda left, known, time: (0.0, 10))
    assert accusations() > 10


@pytest.mark.parametrize(("n", "rho", "change"), [(300, 0.0, 1.6), (600, 0.5, 1.5), (3000, 0.9, 2.0)])
def test_a_drift_is_found(n: int, rho: float, change: float) -> None:
    rng, ramp = np.random.default_rng(6), change * np.linspace(0, 1, n)
    logs = [(neighbours(n, rho, rng) + ramp, visited(n, "anywhere", rng)) for _ in range(20)]
    assert sum(told(r, z, 4.0) for r, z in logs) >= 16
    found: dict[str, Any] | None = drift(logs[0][0], np.ones(n), logs[0][1])
    assert found is not None
    assert found["change"] == pytest.approx(change, abs=5 * found["error"])
    assert found["samples"] <= n


def test_drifts_far_below_gamma_and_short_logs_are_not_told() -> None:
    rng, n = np.random.default_rng(7), 400
    r, z = neighbours(n, 0.0, rng) + 2 * np.linspace(0, 1, n), visited(n, "anywhere", rng)
    assert told(r, z, 1.0)
    assert not told(r, z, 100.0)
    assert drift(r[:60], np.ones(60), z[:60]) is None
    # Along a log on which time is a function of z nothing is known of a trend.
    assert drift(r, np.ones(n), np.linspace(-1, 1, n)[:, None]) is None
    # Nor of a log that is worth few samples, however steep it looks.
    few = drift(neighbours(n, 0.999, rng), np.ones(n), z)
    assert few is not None
    assert (few["error"], few["trend"]) == (None, False)
