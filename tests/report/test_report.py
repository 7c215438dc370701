import html
import json
import re
import shutil
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from gapcert import Event, UsageError
from gapcert.contracts.plugins.events import silent
from gapcert_figures.data import Band, Figures, Lane, gap_figure
from gapcert_report.illustrator import Illustrator
from gapcert_report.pages.page import write_report
from gapcert_report.pictures.gap import band_pictures
from gapcert_report.words.summary import in_words, markdown
from gapcert_report.words.words import claim_sentence, loop_sentence, number, plain, refutation, witness_sentence

SCRIPTS = re.compile(r"<script( type=\"application/json\")?>(.*?)</script>", re.S)
WITNESS = {"z": [0.1, 0.2, 0.3], "at": {"theta": 0.1, "omega": 0.2, "torque": 0.3}, "state": 0}
WITNESS |= {"residual": 1.5, "low": -1.0, "high": 1.0}
HOSTILE = "<script>alert(1)</script>&\"'"


@pytest.fixture
def folder(small_run, tmp_path):
    """A copy of the small run's folder that a test may spoil."""
    return shutil.copytree(small_run.folder, tmp_path / "run")


def spoil(folder, change):
    """The report, in words alone, of a run whose summary was changed."""
    (folder / "figures.json").unlink()
    summary = json.loads((folder / "summary.json").read_text())
    change(summary)
    (folder / "summary.json").write_text(json.dumps(summary))
    return write_report(folder).read_text()


def same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def test_the_run_leaves_a_report_that_needs_nothing_else(small_run):
    path = small_run.folder / "report.html"
    text = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 1.5e6
    assert not re.search("https?:", text)
    bare = re.sub(r"base64,[^\"]*", "", SCRIPTS.sub("", text))
    assert not re.findall(r"//[a-z]|<script|<link|<iframe|<object|@import|\ssrc=|\son\w+=|\sstyle=", bare)
    # One script that runs, which is the package's own; all others are data.
    assert [kind for kind, _ in SCRIPTS.findall(text)].count("") == 1
    assert all(json.loads(inner) for kind, inner in SCRIPTS.findall(text) if kind)
    links = re.findall(r'href="([^"]*)"', text) + re.findall(r"url\(([^)]*)\)", text)
    assert links
    assert all(x.startswith(("#", "data:image/png;base64,")) for x in links if x != "#${id}")


def test_the_answer_stands_before_the_evidence(small_run):
    text = (small_run.folder / "report.html").read_text(encoding="utf-8")
    order = [
        "✓ Holds",
        "provided that the assumptions",
        "Expectations",
        "How wrong can the model be?",
        "What the claim rests on",
    ]
    order += ["What does it buy a controller?", "gapcert verify"]
    text = text[text.index("<main") :]
    places = [text.index(x) for x in order]
    assert places == sorted(places)


def test_structure_for_readers_and_machines(small_run):
    text = (small_run.folder / "report.html").read_text(encoding="utf-8")
    assert text.count("<h1>") == 1
    svgs = re.findall(r'<div class="plot">(<svg [^>]*>)', text)
    assert len(svgs) >= 8
    assert len(svgs) == text.count("<figure>")
    assert all('role="img"' in s and re.search(r'aria-label="[^"]{20,}"', s) for s in svgs)
    assert text.count("<table>") == text.count("<caption>")
    assert re.search(r"<caption>Versions</caption>.*?numpy", text, re.S)
    ids = re.findall(r'\sid="([^"]*)"', text)
    assert len(ids) == len(set(ids))
    for unit in ("theta [rad]", "omega [rad/s]", "torque [N·m]", "time [s]"):
        assert unit in text


@pytest.mark.exam
def test_redrawn_from_the_folder_alone_with_the_same_bytes(small_run, folder):
    first = (small_run.folder / "report.html").read_text().replace(small_run.folder.name, folder.name)
    assert write_report(folder).read_text() == first


def test_without_figures_the_words_remain(folder):
    (folder / "figures.json").unlink()
    text = write_report(folder).read_text()
    assert "<svg" not in text
    assert "How wrong can the model be?" in text


def test_figures_survive_the_folder(folder):
    figures = Figures.load(folder)
    assert figures.gap
    assert figures.winning
    assert figures.loop
    figures.save(folder)
    assert same(Figures.load(folder), figures)
    assert not same(replace(figures, lanes=()), figures)


def test_figures_that_do_not_fit_are_refused(folder):
    data = json.loads((folder / "figures.json").read_text())
    data["gap"]["samples"] = "/nowhere"
    (folder / "figures.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match="do not fit"):
        write_report(folder)


def test_everything_is_escaped(folder):
    def change(summary):
        summary["name"] = summary["reason"] = HOSTILE
        summary["verdict"] = "fails"
        summary["expectations"] = [{"text": HOSTILE, "value": HOSTILE, "met": False}]
        summary["certificate"]["assumptions"] = [HOSTILE]
        summary["certificate"]["states"][HOSTILE] = summary["certificate"]["states"]["theta"]
        summary["certificate"]["claim"] = {"kind": "statistical", "epsilon": 1e-3, "beta": 1e-6, "distribution": HOSTILE}
        summary["timings"][HOSTILE] = 1.0

    text = spoil(folder, change)
    assert "<script" not in SCRIPTS.sub("", text)
    assert text.count("&lt;script&gt;") >= 8


def test_a_hostile_name_in_a_picture_is_escaped(folder):
    gap = Figures.load(folder).gap
    Figures(gap=replace(gap, slices=(), bands=(replace(gap.bands[0], state=HOSTILE),))).save(folder)
    text = write_report(folder).read_text()
    assert "<script" not in SCRIPTS.sub("", text)
    assert text.count("&lt;script&gt;") >= 3


CLAIMS = {
    "deterministic": ({"kind": "deterministic"}, "Everywhere on the domain"),
    "statistical": (
        {"kind": "statistical", "epsilon": 1e-3, "beta": 1e-6, "distribution": "uniform"},
        "With confidence 1 − 10⁻⁶",
    ),
    "empirical": ({"kind": "empirical"}, "not a proof"),
}


@pytest.mark.parametrize("kind", CLAIMS)
def test_no_sentence_says_more_than_its_claim(kind):
    claim, says = CLAIMS[kind]
    audit = {"points": 100, "violations": 0}
    text = claim_sentence({"claim": claim, "audit": audit})
    assert says in text
    assert ("Everywhere" in text) == (kind == "deterministic")
    assert ("assumptions" in text) == (kind == "deterministic")
    assert claim_sentence({"claim": claim, "audit": audit | {"violations": 3}}).startswith("Refuted: at 3 of 100")


def test_runs_are_not_a_claim():
    runs = {"violations": 0, "starts": 5}
    summary = {"closed_loop": {"with_gamma": runs, "without_gamma": runs | {"violations": 2}}}
    empirical = loop_sentence(summary | {"controller": {"claim": {"kind": "empirical"}}})
    assert "without γ 2 of 5 starts broke" in empirical
    assert "with γ none of 5 did" in empirical
    assert "not a claim about others" in empirical
    assert "hidden" not in empirical
    strange = summary["closed_loop"] | {"hidden_outside": 0.125}
    assert "12 % of the steps with γ began with hidden state" in loop_sentence({"closed_loop": strange})
    assert loop_sentence({}) == ""


def test_refuted_runs_show_the_witness_and_the_reason(folder):
    def change(summary):
        summary |= {"verdict": "fails", "reason": "the audit refutes the gap function"}
        audit = summary["certificate"]["audit"]
        audit |= {"violations": 7, "points": 100, "witness": WITNESS}

    text = spoil(folder, change)
    assert "✗ Fails" in text
    assert "the audit refutes the gap function" in text
    assert "Refuted: at 7 of 100" in text
    assert "Worst at theta = 0.1, omega = 0.2, torque = 0.3: there f̂ − f of theta is 1.5, outside [-1, 1]." in text
    assert "the mean gap of" not in text[text.index('aria-label="Answer"') : text.index('class="symbols"')]
    assert '<li class="bad"><strong>7 <small>of 100' in text


def test_what_a_claim_rests_on_has_its_units_as_axes_have_them():
    assert plain("u in [-1, 1] N*m, a in [0, 1e-07] m/s^2, and/or x") == "u in [-1, 1] N·m, a in [0, 10⁻⁷] m/s², and/or x"


def test_a_band_whose_ends_have_crossed_is_told_as_none():
    crossed = {"audit": {"witness": WITNESS | {"low": 2.0, "high": 1.0}}, "states": {"theta": {}}}
    assert witness_sentence(crossed).endswith("where no band is left: its lower end, 2, lies above its upper one, 1.")


def test_every_policy_is_tabled_and_the_failing_ones_named(folder):
    def change(summary):
        row = {"starts": 10, "steps": 60, "violations": 0, "stranded": 0, "left_goal": 0}
        policies = [
            row | {"policy": p, "controller": c} for p in ("first", "last", "random") for c in ("with_gamma", "without_gamma")
        ]
        for r in policies:
            if r["controller"] == "without_gamma" and r["policy"] != "last":
                r["violations"] = 4
        summary["closed_loop"]["policies"] = policies

    text = spoil(folder, change)
    assert "Fails without γ: policies first and random." in text
    table = re.search(r"Closed loop on the simulator.*?</table>", text, re.S).group()
    assert len(re.findall("<tr>", table)) == 7
    assert table.count("✗ no") == 2


def test_broken_promises_and_the_audit_of_runs_are_told(folder):
    def change(summary):
        row = {"policy": "first", "starts": 10, "steps": 60, "violations": 0, "stranded": 0, "left_goal": 0}
        judged = {"broken_promises": 3, "steps_held": 600, "outside_gap": 17, "refuted": {"gap": 0, "bound": 3}}
        without = row | {"controller": "without_gamma", "broken_promises": 9}
        claim = {"kind": "statistical", "epsilon": 0.4988, "beta": 0.001, "distribution": "starts", "runs": 10, "violations": 0}
        summary["closed_loop"] = {"with_gamma": row, "claim": claim, "skipped": ["adversarial with gamma"]}
        summary["closed_loop"]["policies"] = [row | {"controller": "with_gamma"} | judged, without]

    text = spoil(folder, change)
    told = "3 steps under policy 'first' break the controller's promise: 3 refute the bound of the model's successors."
    assert told in html.unescape(text)
    assert "breaks the specification under policy first with probability 0.4988 at most" in text
    assert "Asked for, and not run since these controllers do not know them: adversarial with γ." in text
    table = re.search(r"Closed loop on the simulator.*?</table>", text, re.S).group()
    assert "steps outside [l, u]" in table
    assert ">17 of 600<" in table
    assert "10 runs of at most 60 steps each" in table


@pytest.mark.parametrize("reached", [7, 10])
def test_runs_that_have_not_arrived_are_told(folder, reached):
    def change(summary):
        row = {"starts": 10, "steps": 60, "violations": 0, "stranded": 0, "left_goal": 0, "reached": reached}
        summary["closed_loop"] = {c: row | {"policy": "first"} for c in ("with_gamma", "without_gamma")}
        summary["closed_loop"]["policies"] = [row | {"policy": p, "controller": "with_gamma"} for p in ("first", "last")]

    text, late = spoil(folder, change), reached < 10
    told = "still on the way to the target after the last step: 3 of 10 runs under policy first and 3 of 10"
    assert (told in text) == ("after 60 steps 3 of them had not reached the target" in text) == late
    table = re.search(r"Closed loop on the simulator.*?</table>", text, re.S).group()
    assert (table.count("? not decided"), table.count("✓ yes")) == ((2, 0) if late else (0, 2))
    assert table.count(f">{reached}<") >= 2


NUMBERS = [(0, "0"), (14502, "14,502"), (0.0, "0"), (1.00547, "1.005"), (4.9631e-5, "4.963\u00a0×\u00a010⁻⁵"), (1e-6, "10⁻⁶")]
NUMBERS += [
    (15195.4, "15,195"),
    (None, "–"),
    (True, "yes"),
    ("text", "text"),
    (float("inf"), "∞"),
    (float("-inf"), "−∞"),
    (float("nan"), "no number"),
    (-2.5e8, "-2.5\u00a0×\u00a010⁸"),
    (0.001, "0.001"),
]


@pytest.mark.parametrize(("value", "text"), NUMBERS)
def test_numbers_are_written_for_people(value, text):
    assert number(value) == text


def test_a_calibrated_claim_says_how_many_violations_would_refute_it():
    audit = {"points": 50, "violations": 2, "allowed": 14}
    claim = {"kind": "statistical", "epsilon": 0.1, "beta": 0.01}
    said = claim_sentence({"claim": claim, "audit": audit, "calibration": {"points": 60}})
    assert said.endswith(
        "60 calibration points set γ, and of 50 fresh points that were looked at afterwards 2 lie outside; 15 would refute it."
    )


@pytest.mark.parametrize("who", ["audit", "attack"])
def test_what_a_claim_allows_refutes_nothing_and_one_more_does(who):
    found = {"points": 50, "violations": 14, "allowed": 14}
    assert refutation({who: found}) is None
    assert "at 15 of 50" in (refutation({who: found | {"violations": 15}}) or "")


def test_markdown_of_the_certificate(small_run):
    text = markdown(small_run.summary)
    assert text.startswith("# small: holds")
    assert "| theta | " in text
    assert "## Assumptions\n\n1. " in text


def test_each_column_of_the_markdown_has_the_figures_of_its_name():
    figures = {"gap_mean": 0.25, "gamma_mean": 0.5, "tightness": 2.0, "constant_bound": 0.75}
    claim = {"claim": {"kind": "empirical"}, "states": {"x": figures}, "audit": {"points": 10}, "assumptions": []}
    head, _, row = (line for line in markdown({"name": "n", "certificate": claim}).splitlines() if line.startswith("|"))
    names, values = ([cell.strip() for cell in line.strip("|").split("|")] for line in (head, row))
    wanted = {"state": "x", "mean gap": "0.25", "mean γ": "0.5", "tightness": "2", "constant": "0.75"}
    assert dict(zip(names, values, strict=True)) == wanted


def test_markdown_says_why_a_run_fails_or_is_open(small_run):
    """The reason stands first, also where there is no certificate; a declared γ is called that."""
    text = markdown({"name": "n", "verdict": "unknown", "reason": "the budget ended at 1.2e-05"})
    assert text == "# n: unknown\n\n**the budget ended at 1.2 × 10⁻⁵.**\n".replace(" × ", "\u00a0×\u00a0")
    failed = markdown(small_run.summary | {"verdict": "fails", "reason": "a witness."})
    assert failed.startswith("# small: fails\n\n**a witness.**\n\n")
    states = {"theta": {"gamma_max": 5e-4}}
    declared = {"states": states, "claim": {"kind": "assumed"}, "assumptions": []}
    assert "| state | declared γ |" in markdown({"name": "n", "verdict": "holds", "certificate": declared})


def test_a_residual_outside_its_band_is_said_to_leave(small_run):
    """The picture evaluates the residual afresh: another simulator than the certified one shows at once."""
    certificate = small_run.certificate
    wrong = gap_figure(certificate, lambda z: np.full((len(z), 2), 1.0), certificate.domain)
    right = Figures.load(small_run.folder).gap
    for gap, says in ((wrong, "leaves its certified band"), (right, "stays inside its certified band")):
        assert says in band_pictures(replace(gap, bands=gap.bands[:1]))[0][0].caption
    flat = next(
        b for b in right.bands if np.ptp(b.residual) < max(np.ptp(o.residual) for o in right.bands if o.state == b.state)
    )
    gone = replace(flat, high=flat.residual - 1.0)
    shown = band_pictures(replace(right, bands=tuple(gone if b is flat else b for b in right.bands)))[0]
    assert f"Gap of {flat.state} along {flat.axis.name}" in [p.title for p in shown]
    assert all(isinstance(b, Band) and len(b.at) == 401 for b in right.bands)
    assert all((s.gamma >= s.gap).all() for s in right.slices)


def test_the_breaking_step_is_where_f_was_wrong(small_run):
    loop = Figures.load(small_run.folder).loop
    assert small_run.summary["closed_loop"]["without_gamma"]["violations"] == (loop.runs[0].broke >= 0).sum() > 0
    escape = loop.escape

    def can_go_on(x):
        column, row = (int((v - a.low) / (a.high - a.low) * 96) for v, a in zip(x, escape.axes, strict=True))
        return escape.domain[row, column] > 0

    assert can_go_on(escape.expected)
    assert not can_go_on(escape.actual)


def test_a_picture_that_fails_becomes_a_warning(tmp_path):
    seen = []
    emit = Illustrator(tmp_path, seen.append)
    emit(Event("stage-finished", "controller", {"with_gamma": None, "without_gamma": object()}))
    assert [e.name for e in seen] == ["warning", "stage-finished"]
    assert "no picture of controller" in seen[0].data["message"]
    assert "figure" not in seen[1].data


def test_lanes_end_what_they_began(tmp_path):
    emit = Illustrator(tmp_path, silent)
    for name, stage in (("run-started", "run"), ("stage-started", "a"), ("stage-started", "b"), ("stage-finished", "a")):
        emit(Event(name, stage))
    lanes = {lane.stage: lane for lane in emit.figures.lanes}
    assert lanes["b"] == Lane("b", (3, 4), ("running", "done"))
    assert lanes["a"].states == ("running", "done")
    assert lanes["run"].states == ("running",)
    emit(Event("progress", "a", {"done": 1}))
    assert emit.figures.lanes == tuple(lanes.values())


@pytest.mark.parametrize(("content", "says"), [(None, "no summary.json"), ("{", "cannot be read"), ("{}", "cannot be read")])
def test_a_folder_without_a_run_is_one_sentence(tmp_path, content, says):
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    with pytest.raises(UsageError, match=says):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


HIDDEN = {
    "mode": "sample", "names": ["z", "yaw"], "harmless": False, "spread": {"x0": 0.5, "x1": 0.25}, "safety": 1.5,
    "ranked": [{"name": "yaw", "spread": {"x0": 0.5, "x1": 0.125}}], "bound": {"x0": 1e-6, "x1": 2e-6},
}  # fmt: skip


def test_what_the_model_leaves_out_is_told_with_its_measured_spread(folder):
    def change(summary):
        states = list(summary["certificate"]["states"])
        renamed = {k: dict(zip(states, HIDDEN[k].values(), strict=False)) for k in ("spread", "bound")}
        ranked = [{"name": "yaw", "spread": dict.fromkeys(states, 0.125)}]
        summary["certificate"]["hidden"] = HIDDEN | renamed | {"ranked": ranked}

    text = spoil(folder, change)
    assert "What the model leaves out" in text
    assert "z and yaw. Each point gets its own, and γ bounds the gap over them." in text
    assert "probe: yaw alone" in text
    assert "2\u00a0×\u00a010⁻⁶" in text, "twice the half width that γ allows for"


def test_a_warning_stands_once_and_vacuous_states_are_named(folder):
    def change(summary):
        c = summary["certificate"]
        c["warnings"] = ["u moves x0 twice as far"]
        c["assumptions"] = [*c["assumptions"], "Warning: u moves x0 twice as far.", "e(x0) = 1.96e-05."]
        c["vacuous"], next(iter(c["states"].values()))["vacuous"] = True, True

    text = spoil(folder, change)
    assert text.count("u moves x0 twice as far.") == 1
    assert "e(x0) = 1.96\u00a0×\u00a010⁻⁵." in text
    assert "it is vacuous: a constant, or a model in which nothing moves, would do as well" in text
    assert "Holds, in part vacuous" in text or "Holds, but vacuous" in text
    summary = json.loads((folder / "summary.json").read_text())
    assert any("vacuous for " in line for line in in_words(summary))


def test_maps_are_drawn_over_axes_along_which_something_changes(small_run):
    """Where nothing depends on the first state, the others carry the picture."""
    certificate = small_run.certificate
    figure = gap_figure(certificate, lambda z: z[:, [1, 2]] + 0.01 * z[:, :1], certificate.domain)
    assert [a.name for a in figure.axes] == ["omega", "torque", "theta"]
    assert figure.fixed.startswith("theta = ")
    assert (np.ptp(figure.slices[0].gap, axis=1) > 0.1).all(), "columns are the first axis, omega"
    assert [a.name for a in Figures.load(small_run.folder).gap.axes] == ["theta", "omega", "torque"]
