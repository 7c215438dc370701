"""Axes that an engineer reads at a glance: no offsets to add in the head, and as many lags as a slow plant has."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from gapcert.contracts.systems.system import StateSpec
from gapcert_diagnosis.figure import _correlations
from gapcert_figures.data import Axis, Escape
from gapcert_figures.diagnosis import Channel, Correlation, Course, DiagnosisFigure, Law
from gapcert_report.pictures.control import escape_picture
from gapcert_report.pictures.diagnosis import (
    channel_picture,
    correlation_picture,
    course_picture,
    diagnosis_album,
    gain_picture,
    law_picture,
)
from gapcert_report.pictures.svg import draw


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
    known = {"hypothesis": SimpleNamespace(model=model), "windows": windows}
    fits = [SimpleNamespace(residual=rng.standard_normal((9, 120, 1)), **known) for _ in "ab"]
    own, driven = _correlations(*fits)
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


GAIN = {"before": 1.0, "after": 0.1, "low": 0.09, "high": 0.12}


@pytest.mark.parametrize(
    ("units", "label"),
    [
        ({"p": "m", "v": "m/s"}, "held-out error, RMSE [each in its unit]"),
        ({"p": "m", "v": "m"}, "held-out error, RMSE [m]"),
        ({"p": "", "v": ""}, "held-out error, RMSE"),
    ],
)
def test_the_axis_of_what_was_gained_is_whole_and_has_a_unit_where_there_is_one(units, label):
    from matplotlib.textpath import TextPath

    p = gain_picture({"causes": [{}], "gain": {"3": {"p": GAIN, "v": GAIN}}, "units": units})
    assert f">{label}<" in p.svg
    (x,) = re.findall(rf'x="([\d.]+)"[^>]*>{re.escape(label)}<', p.svg)
    width, needed = float(p.svg.split('viewBox="0 0 ')[1].split()[0]), TextPath((0, 0), label, size=9.5).get_extents().width
    assert needed / 2 < float(x) < width - needed / 2


@pytest.mark.exam
@pytest.mark.parametrize(("quoted", "shown"), [("position", "y"), ("rate", "w"), ("x", "x"), ("", "w")])
def test_the_first_picture_of_a_diagnosis_is_of_what_its_answer_quotes(quoted, shown):
    t = np.linspace(0, 1, 50)
    motion = np.sin(7 * t)
    wrong = {"x": ("m", 0.5), "y": ("m", 0.9), "w": ("rad/s", 3.0)}  # by how much each was wrong before
    channels = tuple(Channel(n, unit, t, motion, (1 + by) * motion, motion) for n, (unit, by) in wrong.items())
    gain = {"3": {quoted: GAIN}} if quoted else {}
    summary = {"causes": [], "gain": gain, "units": {"position": "m", "rate": "rad/s", "x": "m"}}
    assert diagnosis_album(DiagnosisFigure(channels, ()), summary).hero[0].title == f"{shown} on held-out data"


def test_an_axis_is_scaled_to_the_intervals_too():
    x, tiny = np.linspace(-1, 1, 9), 1e-15 * np.ones(9)
    p = law_picture(
        0, Law("what is left at q", "q [rad]", "missing force [N*m]", x, tiny, np.array([]), np.array([]), 4e-5 + tiny)
    )
    assert "missing force [10⁻⁵ N·m]" in p.svg
    assert "1e1" not in p.svg


@pytest.mark.parametrize(("before", "log"), [([20.0, 30.0], True), ([1.1, 1.02], False)])
def test_residuals_close_to_noise_are_shown_without_powers(before, log):
    p = course_picture(0, Course(np.array([0.0, 1.0]), np.array(before), np.array([1.02, 0.97])), False)
    assert p.data["y"]["log"] == log
    assert "×" not in p.svg


def test_what_a_picture_is_called_ends_no_attribute():
    drawn = draw("key", "title", '"><b>', lambda ax: ax.plot([0.0, 1.0])).svg
    assert 'aria-label="&quot;&gt;&lt;b&gt;"' in drawn
    assert "<b>" not in drawn
