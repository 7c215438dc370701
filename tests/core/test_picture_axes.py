"""Axes that an engineer reads at a glance: no offsets to add in the head, and as many lags as a slow plant has."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from gapcert.diagnosis.figure import _correlations
from gapcert.diagnosis.shown import Channel, Correlation
from gapcert.figures import Axis, Escape
from gapcert.report.diagnosis_pictures import channel_picture, correlation_picture
from gapcert.report.pictures import escape_picture
from gapcert.system import StateSpec


def test_a_run_that_breaks_is_seen_from_where_it_was_expected():
    axes = Axis("theta", "rad", 0.0009, 0.0012), Axis("omega", "rad/s", -0.00793794, -0.0079314)
    expected, actual = np.array([0.001052, -0.007934]), np.array([0.00099, -0.0079349])
    p = escape_picture(Escape(axes, np.ones((4, 4)), 266, expected, expected, actual))
    labels = re.findall(r">([^<>]* − expected[^<>]*)<", p.svg)
    assert labels == ["theta − expected [10⁻⁴ rad]", "omega − expected [10⁻⁶ rad/s]"]
    assert "f expects theta = 0.001052 rad and omega = -0.007934 rad/s, from where its controller can go on" in p.caption


def test_values_that_hardly_change_are_written_out():
    t = np.linspace(0, 10, 300)
    y = 2.5 + 1e-6 * np.sin(t)
    p = channel_picture(0, Channel("h", "m", t, y, y + 2e-7, y + 1e-8))
    assert "2.500001" in p.svg
    assert "e−6" not in p.svg


@pytest.mark.parametrize(
    ("before", "reach", "said"),
    [
        (0.5, (-1, 1), False),  # no room for what no line needs
        (1.8, (-1.8, 1.8), False),
        (50.0, (-3, 3), True),
        (5e6, (-3, 3), True),
    ],
)
def test_a_simulation_leaves_its_picture_only_where_it_would_flatten_the_others(before, reach, said):
    t = np.linspace(0, 10, 301)
    y = np.sin(2 * np.pi * t / 10)
    p = channel_picture(0, Channel("h", "m", t, y, np.where(y == 0, 0, before * np.sign(y)), 0.99 * y))
    assert np.allclose(p.data["y"]["limits"], reach, atol=0.4)
    assert ("outside of the picture" in p.caption) == said
    assert p.data["y"]["unit"] == "m"


@pytest.mark.parametrize(("period", "lags"), [(0.01, 50), (5.0, 24)])
def test_a_slow_plant_has_lags_too(period, lags):
    rng = np.random.default_rng(0)
    measured = SimpleNamespace(
        period=period, history=1, channels=(StateSpec("h", "m"),), samples=lambda s: max(1, round(s / period))
    )
    windows = SimpleNamespace(measured=measured, length=120, u=rng.standard_normal((9, 121, 1)))
    model = SimpleNamespace(nu=1, inputs=(StateSpec("q", "m^3/s"),))
    fits = [SimpleNamespace(residual=rng.standard_normal((9, 120, 1)), hypothesis=SimpleNamespace(model=model)) for _ in "ab"]
    own, driven = _correlations(windows, *fits)
    assert (len(own.lag), len(driven.lag)) == (lags, 2 * lags + 1)
    assert own.lag[-1] == pytest.approx(lags * period)


def test_few_lags_are_seen_one_by_one():
    """A line through one point is no line."""
    one = Correlation("h", "itself", np.array([5.0]), np.array([0.9]), np.array([0.1]), 0.05)
    assert len(re.findall(r"<use ", correlation_picture(0, one).svg)) > len(
        re.findall(r"<use ", correlation_picture(0, _many()).svg)
    )


def _many():
    lag = np.arange(1.0, 200.0)
    return Correlation("h", "itself", lag, 0.9 / lag, 0.1 / lag, 0.05)
