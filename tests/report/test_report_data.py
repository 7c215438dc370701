"""What a page tells of a picture is what was drawn: read off the axes, packed into JSON, and small."""

import base64
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gapcert as gc
from gapcert_figures.data import Axis, Band, Figures, GapFigure
from gapcert_report.pages.page import write_report
from gapcert_report.pictures.album import album_of
from gapcert_report.pictures.gap import band_pictures, slice_pictures
from gapcert_report.pictures.svg import draw, heat, packed
from gapcert_report.words.words import claim_sentence, tightness_sentence

DATA = re.compile(r'<script type="application/json">(.*?)</script>', re.S)


@given(st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), max_size=30), st.floats(-1e9, 1e9))
def test_packed_arrays_keep_seven_digits(values, offset):
    array = np.array(values, float) + offset
    back = unpacked(json.loads(json.dumps(packed(array), allow_nan=False)))
    known = array[np.isfinite(array)]
    least = 1e-6 * (np.ptp(known) if len(known) else 0) + 1e-15 * abs(offset) + 1e-37
    assert np.array_equal(np.isnan(back), np.isnan(array))
    assert np.allclose(back, array, rtol=2e-7, atol=least, equal_nan=True)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.linspace(1e5, 1e5 + 3, 601), "step"),
        (np.repeat([0.0, np.nan, 1.0], 50), "runs"),
        (np.random.default_rng(1).normal(size=100), "f32"),
        (1e5 + np.random.default_rng(1).normal(size=100) * 1e-3, "f32"),
    ],
)
def test_packed_arrays_are_small(values, kind):
    data = packed(values)
    assert kind in data
    assert len(json.dumps(data)) < 7 * len(values)
    assert np.nanmax(np.abs(unpacked(data) - values)) <= 1e-7 * np.ptp(values[np.isfinite(values)])


def unpacked(data):
    """The array that `packed` was given, to seven digits."""
    if "n" in data:
        return np.asarray(data["first"] + data["step"] * np.arange(data["n"]))
    if "runs" in data:
        return np.concatenate([np.full(c, np.nan if v is None else v) for v, c in data["runs"]])
    return np.asarray(np.frombuffer(base64.b64decode(data["f32"]), "<f4").astype(float) + data["offset"])


def arrays(series):
    return [{k: unpacked(v) if isinstance(v, dict) else v for k, v in part.items()} for part in series["parts"]]


def test_a_band_is_read_off_as_it_is(small_run):
    gap = Figures.load(small_run.folder).gap
    picture = band_pictures(gap)[0][0]
    b = next(b for b in gap.bands if picture.title == f"Gap of {b.state} along {b.axis.name}" and np.ptp(b.residual))
    named = {s["name"]: s for s in picture.data["series"]}
    assert [e.name for e in picture.legend] == ["±γ", "[l, u]", "f̂ − f", "constant bound"]
    assert set(named) == set(map(str, [e.name for e in picture.legend]))
    power = re.search("10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", picture.data["y"]["unit"])[1]
    unit = 10.0 ** int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")))
    (line,), (inner,), (outer,) = (arrays(named[n]) for n in ("f̂ − f", "[l, u]", "±γ"))
    close = {"rtol": 1e-5, "atol": 1e-6 * b.constant}
    assert np.allclose(line["x"], b.at)
    assert np.allclose(line["y"] * unit, b.residual, **close)
    assert np.allclose(inner["low"] * unit, b.low, **close)
    assert np.allclose(inner["high"] * unit, b.high, **close)
    assert np.allclose(outer["high"] * unit, b.gamma, **close)
    assert sorted(p["y"][0] * unit for p in arrays(named["constant bound"])) == pytest.approx(
        [-b.constant, b.constant], rel=1e-5
    )


@pytest.mark.parametrize("refuted", [False, True])
def test_a_refuted_band_is_hatched_and_an_empty_one_is_called_that(refuted):
    at = np.linspace(-2.0, 5.0, 301)
    low, high = 0.3 * np.sin(at) - 0.2, 0.3 * np.sin(at) + 0.4 - 0.25 * np.abs(at)
    band = Band("v", "m/s", Axis("a", "1", -2.0, 5.0), at, 0 * at, low, high, np.full(301, 0.9), 1.2)
    picture = band_pictures(GapFigure((band.axis,), "", (), (band,), np.zeros((0, 1))), refuted)[0][0]
    series = {s["name"]: arrays(s) for s in picture.data["series"]}
    mark = ", refuted" if refuted else ""
    assert set(series) == {f"±γ{mark}", f"[l, u]{mark}", "no band: l above u", "f̂ − f", "constant bound"}
    assert [("var(--with)" in e.swatch) for e in picture.legend] == [not refuted, not refuted, False, False, False]
    # What is filled has l below u, and what is empty is hatched, in no face colour, where they have crossed.
    for part in series[f"[l, u]{mark}"]:
        assert (np.interp(part["x"], at, high - low) >= -0.02).all()
    for part in series["no band: l above u"]:
        assert (np.interp(part["x"], at, low - high) >= -0.02).all()
    assert ("fill: var(--with)" in picture.svg) == (not refuted)
    assert picture.svg.count("<pattern") == (2 if refuted else 1)
    assert ("its refuted band" in picture.caption, "certified" in picture.caption) == (refuted, not refuted)
    assert "no value is left in it" in picture.caption


def test_pictures_and_words_of_a_refuted_certificate_agree(small_run):
    figures, audit = Figures.load(small_run.folder), small_run.summary["certificate"]["audit"]
    broken = small_run.summary | {"certificate": small_run.summary["certificate"] | {"audit": audit | {"violations": 3}}}
    for summary, refuted in ((small_run.summary, False), (broken, True)):
        made = album_of(figures, summary)
        pictures = (*made.hero, *made.pairs, *made.bands, *made.other_axes)
        gap = [p for p in pictures if p.title.startswith(("Gap of", "Certified", "Refuted"))]
        assert len(gap) >= 4
        assert all(("refuted" in (p.title + p.caption).lower()) == refuted for p in gap)
        assert claim_sentence(summary["certificate"]).startswith("Refuted") == refuted


def test_a_map_is_read_off_as_it_is(small_run):
    gap = Figures.load(small_run.folder).gap
    for s, picture in zip(gap.slices, slice_pictures(gap)[1::2], strict=True):
        (part,) = arrays(picture.data["series"][0])
        assert (part["rows"], part["columns"]) == s.gamma.shape
        assert part["x"] == [gap.axes[0].low, gap.axes[0].high]
        shape = part["values"] / np.nanmax(part["values"])
        assert np.allclose(shape, s.gamma.ravel() / np.nanmax(s.gamma), atol=1e-6, equal_nan=True)


@pytest.mark.exam
def test_every_picture_of_a_run_has_values_and_its_series_have_names(small_run):
    made = album_of(Figures.load(small_run.folder), small_run.summary)
    pictures = [p for part in (made.hero, made.pairs, made.bands, made.other_axes, made.loop) for p in part]
    assert len(pictures) >= 8
    for p in pictures:
        assert p.data, p.title
        assert all(s["parts"] and not s["name"].startswith("_") for s in p.data["series"])
        # A legend that names a line names one that can be hidden.
        shown = set(re.findall(r'data-s="s(\d+)"', p.svg))
        lines = {str(k) for k, s in enumerate(p.data["series"]) if s["kind"] != "map"}
        assert lines <= shown, p.title


def test_lines_without_a_name_go_with_those_that_look_alike():
    def on(ax):
        ax.plot([0, 1], [0, 1], color="red", label="runs")
        ax.plot([0, 1], [1, 2], color="red")
        ax.plot([0, 1], [1, 2], color="blue")

    picture = draw("k", "t", "c", on)
    assert [(s["name"], len(s["parts"])) for s in picture.data["series"]] == [("runs", 2)]
    assert [e.name for e in picture.legend] == ["runs"]
    assert "runs" not in picture.svg


def test_an_axis_of_names_has_nothing_to_be_read_off():
    def on(ax):
        ax.barh([0, 1], [1, 2])
        ax.set_yticks([0, 1], ["a", "b"])

    assert draw("k", "t", "c", on).data is None


def test_a_map_is_an_image_of_its_cells(small_run):
    """Drawn cell by cell, it weighs what its cells weigh, however large it is shown."""
    axes = Figures.load(small_run.folder).gap.axes
    pictures = [draw("k", "t", "c", lambda ax, n=n: heat(ax, axes, np.ones((n, n)), 2, "v")) for n in (10, 20)]
    sizes = [len(re.search(r"base64,([^\"]*)", p.svg)[1]) for p in pictures]
    assert max(sizes) < 1000


def weight(page):
    return len(page.read_bytes())


def test_the_weight_of_a_page_is_bounded(small_run, tmp_path, every_picture):
    """Bytes are as the data: nothing timed. The limit of the largest run is 5 MB; these are small ones of each kind."""
    assert weight(small_run.folder / "report.html") < 700_000
    Figures(diagnosis=every_picture).save(tmp_path)
    summary = {"name": "d", "verdict": "nothing", "causes": [], "timings": {}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    assert weight(write_report(tmp_path)) < 200_000


@pytest.mark.exam
def test_a_longer_run_makes_no_larger_page(small_run, tmp_path):
    """Twenty times the steps of the runs that are drawn: curves are thinned to what can be seen."""
    figures = Figures.load(small_run.folder)

    def longer(runs):
        stretch = lambda v: np.repeat(v, 20, axis=1)  # noqa: E731
        traces, predicted = stretch(runs.traces), stretch(runs.predicted)
        broke, ended = (np.where(v < 0, v, 20 * v) for v in (runs.broke, runs.ended))
        return replace(runs, steps=20 * runs.steps, traces=traces, predicted=predicted, broke=broke, ended=ended)

    folder = shutil.copytree(small_run.folder, tmp_path / "run")
    replace(figures, loop=replace(figures.loop, runs=tuple(map(longer, figures.loop.runs)))).save(folder)
    assert weight(write_report(folder)) < 1.3 * weight(small_run.folder / "report.html")


def test_what_is_met_is_folded_and_what_is_not_stands_first(small_run, tmp_path):
    folder = shutil.copytree(small_run.folder, tmp_path / "run")
    assert "<details><summary>✓ 1 of 1 that the spec states are met" in (folder / "report.html").read_text()
    (folder / "figures.json").unlink()
    summary = json.loads((folder / "summary.json").read_text())
    summary["expectations"] = [{"text": n, "value": 1, "met": n == "good"} for n in ("good", "wrong")]
    (folder / "summary.json").write_text(json.dumps(summary))
    text = write_report(folder).read_text()
    assert "✗ 1 of 2 that the spec states are met" in text
    assert text.index(">wrong<") < text.index(">good<")


def test_runs_of_a_matrix_lead_to_each_other(tmp_path):
    model = {
        "kind": "equations", "states": {"q": "m"}, "inputs": {"F": "m/s"}, "derivative": {"q": "F - r*q"},
        "parameters": {"r": "0.1 1/s"},
        "integrator": "euler", "period": "20 ms",
    }  # fmt: skip
    spec = {
        "version": 1, "name": "m", "model": model, "backend": model | {"integrator": "rk4"},
        "domain": {"q": [-1, 1], "F": [-1, 1]}, "sampling": {"kind": "adaptive", "budget": 20, "executor": "threads"},
        "lipschitz": {"residual": {"kind": "interval"}}, "certificate": {"claim": "deterministic"},
        "report": {"rerun": False}, "matrix": {"gap.kind": ["envelope", "constant"]},
        "gap": {"kind": "envelope"},
    }  # fmt: skip
    made = gc.run(spec, out=tmp_path)
    first, second = (r.folder for r in made.runs)
    for here, there in ((first, second), (second, first)):
        text = (here / "report.html").read_text()
        assert f'<a href="../{there.name}/report.html">' in text
        assert f'<a href="../{here.name}/report.html" aria-current="page">' in text
    assert "gap.kind = constant" in (first / "report.html").read_text()


def test_of_many_states_there_is_a_range():
    states = {f"x{k}": {"tightness": 1 + k / 10} for k in range(5)}
    told = tightness_sentence({"states": states, "audit": {"points": 1}})
    assert told == "γ is on average 1.000 to 1.400 × the mean gap of each of 5 states."
