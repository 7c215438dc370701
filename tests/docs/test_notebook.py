"""Results as a notebook shows them, and the notebook of the documentation, executed."""

import dataclasses
import importlib.util
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import gapcert as gc
from gapcert.contracts.plugins.presentation import Shown, view
from gapcert.run.run import Run
from gapcert_diagnosis.results import Cause, Diagnosis, Estimate, Gain
from gapcert_figures.data import CompareFigure
from gapcert_report import notebook

ROOT = Path(__file__).parents[2]
VOID = {"meta", "br", "hr", "path", "use", "rect", "image", "line", "circle", "stop"}


class Whole(HTMLParser):
    """Refuses what is no well-nested fragment; counts its tags."""

    def __init__(self, text):
        super().__init__()
        self.open, self.seen = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.seen.append(tag)
        assert not any(name.startswith("on") for name, _ in attributes), "no script, not even in an attribute"
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


def whole(text):
    """The tags of an output: one box that needs nothing from elsewhere and colours nothing outside."""
    seen = Whole(text).seen
    assert text.startswith('<div class="gapcert">')
    assert "script" not in seen
    assert not re.search(r"https?://", text)
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    selectors = re.findall(r"([^{}]+)\{", style)
    assert all(part.strip().startswith(".gapcert") for s in selectors for part in s.split(","))
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert {*re.findall(r"url\(#([^)]+)\)", text), *re.findall(r'href="#([^"]+)"', text)} <= set(ids)
    return seen


@pytest.mark.exam
def test_a_run_shows_its_verdict_first_and_two_pictures(small_run):
    text = small_run._repr_html_()
    whole(text)
    assert text.index("✓ small: holds") < text.index("|f̂ − f| ≤ γ, provided") < text.index("<table")
    assert text.count('<svg role="img"') == notebook.MOST
    assert "<span>constant bound</span>" in text[: text.index("<figcaption>")]
    assert "1 of 1 expectations met" in text
    assert repr(small_run) == f"Run(small: holds, {small_run.folder})"


def test_a_certificate_shows_its_claim_and_no_more(small_run):
    c = small_run.certificate
    text = c._repr_html_()
    whole(text)
    assert "✓ Deterministic" in text
    assert all(f"<li>{a[:20]}" in text for a in c.assumptions[:1])
    assert re.fullmatch(
        r"Certificate\(deterministic, γ [\d.]+ × the gap of theta, 0 of 14,502 audited points outside\)", repr(c)
    )
    assert str(c) == repr(c)


def test_a_refuted_certificate_says_so_first(small_run):
    c = small_run.certificate
    refuted = dataclasses.replace(c, attack={"points": 10, "violations": 3, "gamma_violations": 3})
    assert "✗ Refuted" in refuted._repr_html_()
    assert repr(refuted).startswith("Certificate(REFUTED")


def test_what_is_assumed_or_only_seen_is_not_green(small_run):
    summary = small_run.certificate.summary()
    for kind, word in (("assumed", "Assumed"), ("empirical", "Empirical")):
        text = notebook.certificate_html(summary | {"claim": {"kind": kind}})
        assert f"{word}</p>" in text
        assert 'class="answer open"' in text


def test_text_is_escaped(small_run):
    summary = small_run.certificate.summary()
    states = {"<script>alert(1)</script>": next(iter(summary["states"].values()))}
    text = notebook.certificate_html(summary | {"states": states, "warnings": ["<b>no</b>"]})
    assert "script" not in whole(text)
    assert "&lt;b&gt;no&lt;/b&gt;" in text


def test_a_diagnosis_shows_causes_and_pictures(every_picture):
    model = gc.load_spec(
        {"version": 1, "name": "m", "model": {"kind": "equations", "states": {"x": "m"}, "inputs": {"u": "m/s"},
                                              "derivative": {"x": "u"}, "integrator": "euler", "period": "1 s"}}
    ).build("model")  # fmt: skip
    gain = {"0.5": {"x": Gain(0.2, 0.1, 0.09, 0.11)}}
    value = Estimate(0.1, "N*m", 0.09, 0.11)
    cause = Cause("coulomb-friction", "x", {"level": value}, 0.9, None, None)
    found = Diagnosis("causes", (cause,), {}, gain, model, figure=every_picture)
    text = found._repr_html_()
    whole(text)
    assert text.count('<svg role="img"') == notebook.MOST
    assert text.index("Causes named") < text.index("Coulomb friction at x") < text.index("<svg")
    assert all(f"<span>{name}</span>" in text for name in ("measured", "before", "after", "named law", "from the data"))
    assert repr(found) == "Diagnosis(causes: coulomb-friction at x 90%)"
    assert repr(dataclasses.replace(found, verdict="nothing", causes=())) == "Diagnosis(nothing)"


def test_a_comparison_shows_who_differs():
    from gapcert_compare.compare import Comparison

    pair = {"a": "one", "b": "two", "mean": 1e-3, "max": 2e-3, "relative": 0.1, "relative_max": 0.2, "resolved": True,
            "explained_by": [], "state": "x", "states": {}}  # fmt: skip
    summary = {"verdict": "differ", "pairs": [pair], "rows": [], "unavailable": [], "agree": {"pairs": 0, "max": None},
               "differ": {"pairs": 1, "explained": 0},
               "backends": {n: {"kind": "equations", "agrees_with": [], "differs_from": [o], "separated_by": []}
                            for n, o in (("one", "two"), ("two", "one"))}}  # fmt: skip
    found = Comparison(summary, CompareFigure(0.01, ()))
    whole(text := found._repr_html_())
    assert "✗ They differ" in text
    assert "one – two" in text
    assert repr(found) == "Comparison(differ: 1 of 1 pairs of 2 simulators differ, 0 explained)"


def test_a_matrix_and_a_run_that_has_no_folder(tmp_path):
    one = gc.Run(tmp_path / "gone", {"name": "one", "verdict": "unknown", "reason": "the budget ended"})
    both = gc.Run(tmp_path, {}, runs=(one, one))
    whole(one._repr_html_())
    assert "the budget ended" in one._repr_html_()
    whole(both._repr_html_())
    assert repr(both) == "Run(2 runs: unknown, unknown)"


@pytest.mark.exam
def test_the_notebook_of_the_documentation_runs_and_says_what_is_stored():
    pytest.importorskip("nbclient", reason="nbclient is not installed (the extra dev has it)")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed (the extra dev has it)")
    spec = importlib.util.spec_from_file_location("execute", ROOT / "docs" / "execute.py")
    execute = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(execute)
    fresh, stored = execute.executed(), json.loads((ROOT / "docs" / "tour.ipynb").read_text())
    assert (ROOT / "docs" / "tour.ipynb").stat().st_size < 250_000

    def said(cells):
        return [
            ["".join(o.get("data", {}).get("text/plain", "")) for o in c["outputs"]] for c in cells if c["cell_type"] == "code"
        ]

    assert said(fresh["cells"]) == said(stored["cells"])
    shown = [o["data"]["text/html"] for c in fresh["cells"] for o in c.get("outputs", ()) if "text/html" in o.get("data", {})]
    assert len(shown) == 4
    for text in shown:
        whole(text)
    printed = [o for c in fresh["cells"] for o in c.get("outputs", ()) if o["output_type"] in ("stream", "error")]
    assert printed == []


@pytest.mark.parametrize("ground", ["#ffffff", "#111111", "#131416"])
def test_a_verdict_can_be_read_in_light_and_in_dark_notebooks(ground):
    """One colour for both grounds cannot have a contrast of 4.5; that of large text, from 18.66 px if bold, is 3."""

    def light(colour):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        r, g, b = (v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    (size,) = re.findall(r"\.verdict { font-size: ([\d.]+)px; font-weight: 700; }", notebook._STYLE)
    assert float(size) > 18.66
    for name in ("good", "bad", "open"):
        (colour,) = re.findall(rf"--{name}: (#\w{{6}});", notebook._STYLE)
        high, low = sorted((light(colour), light(ground)), reverse=True)
        assert (high + 0.05) / (low + 0.05) >= 3, name


def test_results_have_a_plain_line_where_no_plugin_shows_them(monkeypatch):
    class Certificate(Shown):
        def summary(self):
            return {"claim": {"kind": "empirical"}}

    known = gc.registry().components
    monkeypatch.setattr(gc.registry(), "components", {key: c for key, c in known.items() if key[0] != "view"})
    run = Run(Path("runs/n"), {"name": "n", "verdict": "holds"})
    assert [repr(run), repr(Certificate())] == ["Run(holds)", "Certificate(empirical)"]
    assert run._repr_html_() is None
    assert list(view("Run").lines(run.summary)) == ["n: holds"]
