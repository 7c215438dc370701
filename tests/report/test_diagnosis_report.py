"""What a report says of a diagnosis, and that it says no more than was found."""

import json
import re

import pytest

from gapcert_figures.data import Figures
from gapcert_figures.diagnosis import called
from gapcert_report.pages.page import write_report
from gapcert_report.words.diagnosis import dependence, lacking, plus_minus, refitted_named, sentence, shrunk, won
from gapcert_report.words.summary import markdown

COULOMB = {
    "effect": "coulomb-friction",
    "site": "joint2",
    "parameters": {"level": {"value": 0.1312, "unit": "N*m", "low": 0.1272, "high": 0.1352}},
    "explained": 0.752,
    "runner_up": {
        "effect": "viscous-friction", "site": "joint2", "explained": 0.46, "margin": 41.0, "leaves": {"joint2": 0.083},
    },
}  # fmt: skip
GAIN = {"0.4": {"joint2": {"before": 0.153, "after": 0.038, "low": 0.035, "high": 0.041}}}
FOUND = {
    "verdict": "causes", "causes": [COULOMB], "units": {"joint2": "rad"}, "gain": GAIN, "timings": {},
    "residual": {"joint2": {"before": 0.02, "after": 0.0011, "noise_floor": 0.001}},
}  # fmt: skip


def test_the_sentence_that_says_it_all():
    assert sentence(FOUND) == (
        "The simulation lacks Coulomb friction at joint2, 0.131 ± 0.004 N·m; with it the 0.4 s error falls from 0.153 to "
        "0.038 rad; viscous friction, the runner-up, leaves 0.083."
    )


def test_of_several_channels_the_site_is_quoted_or_the_one_that_gained_most():
    gain = {"before": 2.0, "after": 0.1, "low": 0.1, "high": 0.1}
    more = FOUND | {"gain": {"0.4": GAIN["0.4"] | {"joint2_dot": gain}}, "units": {"joint2": "rad", "joint2_dot": "rad/s"}}
    assert "the 0.4 s error of joint2 falls from 0.153 to 0.038 rad" in sentence(more)
    elsewhere = more | {"causes": [COULOMB | {"site": "joint1"}]}
    assert "the 0.4 s error of joint2_dot falls from 2 to 0.1 rad/s" in sentence(elsewhere)


def test_several_causes_a_wrong_parameter_and_a_rival_at_another_site():
    mass = {"effect": "parameter", "site": "m", "parameters": {"value": {"value": 1.2, "unit": "kg", "low": 1.1, "high": 1.3}}}
    rival = {"effect": "input-delay", "site": "u", "explained": 0.2}
    delay = {
        "effect": "input-delay", "site": "u", "explained": 0.5, "runner_up": rival | {"effect": "input-lag", "site": "w"},
        "parameters": {"delay": {"value": 0.012, "unit": "s", "low": 0.0115, "high": 0.0125}},
    }  # fmt: skip
    text = sentence(FOUND | {"causes": [delay, mass | {"explained": 0.3}]})
    assert text.startswith(
        "The simulation lacks an input delay at u, 0.0120 ± 0.0005 s, and m is 1.20 ± 0.10 kg, not as stated;"
    )
    assert "with them the 0.4 s error" in text
    assert text.endswith("input lag at w, the runner-up to input delay, explains 20 % of the error instead of 50 %.")
    alone = sentence(FOUND | {"causes": [mass | {"explained": 0.3}]})
    assert alone.startswith("In the simulation m is 1.20 ± 0.10 kg, not as stated; with it")


def test_two_numbers_of_one_cause_keep_their_names():
    parameters = {n: {"value": v, "unit": "N*s/m", "low": v - 2, "high": v + 2} for n, v in (("plus", 158.0), ("minus", 232.0))}
    text = lacking({"effect": "asymmetric-viscous-friction", "site": "q", "parameters": parameters})
    assert text == "asymmetric viscous friction at q, plus 158 ± 2 N·s/m and minus 232 ± 2 N·s/m"


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (0.1312, 0.004, "0.131 ± 0.004"),
        (0.1312, 0.0014, "0.1312 ± 0.0014"),
        (158.3, 2.4, "158 ± 2"),
        (732109.0, 2808.0, "732,000 ± 3,000"),
        (-1234.0, 15.0, "-1,234 ± 15"),
        (2.5e-6, 3e-8, "(2.50 ± 0.03)\u00a0×\u00a010⁻⁶"),
        (-0.5, 0.05, "-0.50 ± 0.05"),
        (0.3, 0.0, "0.3"),
        (0.3, float("nan"), "0.3"),
    ],
)
def test_no_digit_more_than_the_interval_allows(value, half, text):
    assert plus_minus(value, value - half, value + half) == text


def test_names():
    assert called("asymmetric-coulomb-friction", "q") == "asymmetric Coulomb friction at q"
    assert called("lugre-friction", "q") == "LuGre friction at q"
    assert called("parameter", "mass") == "parameter mass"


def test_other_answers():
    nothing = {"verdict": "nothing", "causes": []}
    assert "more of this recording than its noise" in sentence(nothing)
    seen = [{"effect": "coulomb-friction", "site": "q", "parameter": "level", "value": 0.003, "unit": "N*m"}]
    assert "this would have been seen: Coulomb friction at q from 0.003 N·m." in sentence(nothing | {"smallest": seen})
    many = [seen[0] | {"site": f"q{k}"} for k in range(6)]
    said = "Coulomb friction at q0 from 0.003 N·m, Coulomb friction at q1 from 0.003 N·m, Coulomb friction at q2 from 0.003 N·m"
    assert sentence(nothing | {"smallest": many}).endswith(f"seen: {said} and 3 more.")
    assert "more" not in sentence(nothing | {"smallest": many[:4]}).partition("seen:")[2]
    tie = [[{"effect": "input-lag", "site": "u"}]]
    either = FOUND | {"verdict": "ambiguous", "ambiguous_with": tie, "experiment": "to tell them apart: play fast inputs"}
    said = "This recording cannot tell whether it is Coulomb friction at joint2, or input lag at u. "
    bought = " With the simplest the 0.4 s error falls from 0.153 to 0.038 rad."
    assert sentence(either) == said + "To tell them apart: play fast inputs." + bought
    design = {"name": "fast multisine", "seconds": 12.0, "separation": 0.34, "others": {}, "sentence": "", "rivals": []}
    far = "play fast multisine for 12 s: whatever its numbers, the false one then misses the log by 0.34 noise floors (RMS)."
    assert sentence(either | {"design": design}) == f"{said}To decide, {far}{bought}"
    moved = {"low": -0.5, "high": 1.25, "unit": "rad", "speed": 3.0, "recorded": [-1.0, 2.0], "recorded_speed": 4.0}
    leads = " It should keep q between -0.5 and 1.25 rad (recorded: -1 to 2), at up to 3 rad/s (recorded: 4)."
    begun = {"q": {"value": 0.1, "unit": "rad"}, "u": {"value": 0.0, "unit": "N*m"}}
    whole = design | {"start": begun, "travel": {"q": moved}}
    assert (
        sentence(either | {"design": whole}) == f"{said}To decide, begin at q = 0.1 rad and u = 0 N·m, and {far}{leads}{bought}"
    )
    pair = {"one": COULOMB, "other": tie[0][0], "if_one": 0.01, "if_other": 0.01, "separated": False}
    beyond = " Beyond that, to tell them apart: play fast inputs."
    assert sentence(either | {"design": whole | {"apart": [pair]}}).endswith(f"{leads}{beyond}{bought}")
    assert beyond not in sentence(either | {"design": whole | {"apart": [pair | {"separated": True}]}})
    beside = FOUND["causes"] + [{**COULOMB, "effect": "cogging"}]
    both = either | {"causes": beside, "ambiguous_with": [[COULOMB, *tie[0]]]}
    assert (
        "Beside Coulomb friction at joint2, this recording cannot tell whether it is cogging at joint2, or input lag"
        in sentence(both)
    )
    alike = sentence(FOUND | {"ambiguous_with": tie})
    assert alike.startswith("The simulation lacks Coulomb friction")
    assert alike.endswith("No input within the limits separates this from input lag at u.")
    limited = sentence(FOUND | {"ambiguous_with": tie, "seconds": 12.0})
    said = "No input of 12 s within the limits separates this from input lag at u."
    assert limited.endswith(said)
    besides = {"experiment": "to tell them apart: measure u where it acts"}
    assert sentence(FOUND | besides | {"ambiguous_with": tie, "seconds": 12.0}).endswith(
        f"{said} To tell them apart: measure u where it acts."
    )


def test_a_parameter_is_told_that_moved_by_twice_what_chance_moves_it():
    stated, half, moves = 2.0, 0.03, {"chance": 0.055, "heavier": 0.065, "lighter": -0.065}
    values = {n: stated + d for n, d in moves.items()}
    summary = {
        "refitted": {
            n: {"stated": stated, "value": v, "low": v - half, "high": v + half, "unit": "kg"} for n, v in values.items()
        }
    }
    assert [text.split()[0] for text in refitted_named(summary)] == ["heavier", "lighter"]


def test_what_is_unexplained_is_no_cause():
    rest = {"needs_memory": True, "events": [], "looks_like": {"static": 0.05, "position memory": 0.8}}
    text = sentence(FOUND | {"verdict": "unexplained", "unexplained": rest})
    assert "It has memory" in text
    assert "It looks like a memory of the position: that predicts 80 % of it in data not seen." in text
    assert "Part of the held-out error goes with Coulomb friction at joint2 (75.2 %)" in text
    assert text.endswith("which this does not show to be a cause.")
    bare = sentence({"verdict": "unexplained", "causes": []})
    assert "memory" not in bare
    assert "goes with" not in bare


@pytest.mark.parametrize(
    ("rest", "says"),
    [
        ({"looks_like": {"static": 0.0, "input memory": 0.06}, "where": [[1.5, 2.0], [7.25, 7.5]]},
         "No dependence on state, input or their past was found; it looks like an external disturbance, most of it at 1.5 to "
         "2 s and 7.25 to 7.5 s."),
        ({"looks_like": {"static": 0.02}}, "external disturbance, about as much all along the recording."),
        ({"looks_like": {"static": 0.0}, "events": [{}]}, "was found; single pushes from outside were."),
        ({"looks_like": {"static": 0.4}}, "A function of the present state and input would do"),
        ({"needs_memory": True, "looks_like": {"static": 0.0}}, "It has memory"),
    ],
)  # fmt: skip
def test_what_the_rest_goes_with_is_told_and_that_it_goes_with_nothing(rest, says):
    rest = {"needs_memory": False, "events": []} | rest
    text = sentence({"verdict": "unexplained", "causes": [], "unexplained": rest})
    assert says in text
    assert ("would do" in text) == ("would do" in says)
    assert dependence({"needs_memory": False, "where": [[0.0, 1.0]]}) == ""


PUSH = {"trajectory": "a.csv", "t": 2.5, "duration": 0.08, "site": "joint2", "sign": -1, "size": 0.31, "unit": "N*m*s",
        "low": 0.29, "high": 0.33, "force": 3.9, "force_unit": "N*m"}  # fmt: skip


def test_pushes_are_told_with_their_times_and_sizes(page):
    one = {"verdict": "unexplained", "causes": [], "pushes": [PUSH]}
    assert sentence(one).endswith("Pushes from outside: −0.31 ± 0.02 N·m·s at joint2 from 2.5 s.")
    second = PUSH | {"trajectory": "b.csv", "t": 4.0, "sign": 1}
    assert "at joint2 from 2.5 s of a.csv and +0.31 ± 0.02 N·m·s at joint2 from 4 s of b.csv." in sentence(
        one | {"pushes": [PUSH, second]}
    )
    cause = COULOMB | {"effect": "external-push"}
    assert "Pushes from outside" not in sentence(FOUND | {"causes": [cause], "pushes": [PUSH]})
    shown = page(verdict="unexplained", unexplained={"needs_memory": False}, pushes=[PUSH, second])
    for part in ("a.csv", "2.500 s", "0.080 s", "−0.31 ± 0.02 N·m·s", "3.9 N·m"):
        assert part in whole_text(shown)


def whole_text(page):
    return page.replace("\u00a0", " ").replace("&nbsp;", " ")


def recertified(before, after):
    audit = {"points": 14502, "violations": 0}
    claim = {"claim": {"kind": "empirical"}, "audit": audit, "assumptions": []}
    return {k: claim | {"states": {"q": {"gamma_mean": v}}} for k, v in (("before", before), ("after", after))}


def test_the_controller_before_and_after():
    again = recertified(2e-3, 1e-4)
    assert won({"recertified": again}) is None
    for key, cells in (("before", 10), ("after", 70)):
        again[key]["controller"] = {"kind": "symbolic", "winning_cells": cells, "cells": 100}
    assert won({"recertified": again}) == (0.1, 0.7)
    again["after"]["controller"] = {"refused": "it has memory"}
    assert won({"recertified": again}) is None
    again["after"]["audit"] = {"points": 14502, "violations": 3}
    assert shrunk({"recertified": again}) == []


@pytest.fixture
def page(tmp_path, every_picture):
    """A function that writes the report of a summary, with every picture that a diagnosis may have."""
    Figures(diagnosis=every_picture).save(tmp_path)
    (tmp_path / "extended.yaml").write_text("model: <extended>\n")

    def write(**changes):
        summary = FOUND | {"name": "d", "extended_model": str(tmp_path / "extended.yaml"), "equations": "q⁺ = <q>"} | changes
        (tmp_path / "summary.json").write_text(json.dumps(summary))
        return write_report(tmp_path).read_text()

    return write


@pytest.mark.exam
def test_causes_that_leave_more_than_noise_are_not_green(page):
    assert '<section class="answer good"' in page()
    text = page(causes=[COULOMB | {"flags": ["inadequate: a residual of 1.2 % of the effort is left that is not noise"]}])
    assert '<section class="answer open"' in text
    assert "? Causes named, and something is left" in text


def test_everything_that_was_found_is_on_the_page(page):
    design = {
        "rivals": [{"effect": "input-delay", "site": "u"}, {"effect": "input-lag", "site": "u"}], "name": "fast multisine",
        "sentence": "play it", "seconds": 12.0, "separation": 0.34, "others": {"slow ramp": 0.02},
    }  # fmt: skip
    text = page(
        recertified=recertified(2e-3, 1e-4), design=design, experiment_file="somewhere/experiment.csv",
        ambiguous_with=[[{"effect": "input-lag", "site": "u"}]],
        negligible=[{"effect": "quadratic-drag", "site": "joint2", "share": 0.004}],
        smallest=[{"effect": "cogging", "site": "joint2", "parameter": "amplitude", "value": 0.002, "unit": "N*m"}],
        refitted={"mass": {"stated": 2.0, "value": 2.031, "low": 2.001, "high": 2.061, "unit": "kg"}},
        evidence={"mean square": {"joint2": 1.02}, "with u": {"joint2": 0.4}}, log={"outliers": {"joint2": 3}, "gaps": []},
    )  # fmt: skip
    for part in (
        "✓ Causes named", "The simulation lacks Coulomb friction at joint2, 0.131\u00a0±\u00a00.004 N·m", "75.2 %", "46.0 %",
        "41", "0.035 to 0.041", "20 ×", "What each cause explained", "Rivals", "experiment.csv", "slow ramp",
        "quadratic drag at", "2.03 ± 0.03 kg", "cogging at joint2", "standard deviations",
        "joint2: 3", "&lt;extended&gt;", "q⁺ = &lt;q&gt;", "gapcert extend",
    ):  # fmt: skip
        assert part in text, part
    titles = ("joint2 on held-out data", "Backlash at joint2, against u", "The experiment: u", "Residual over the recording")
    assert all(f"<h3>{t}</h3>" in text for t in titles)
    assert text.count('<div class="plot"><svg ') == 10
    ids = re.findall(r'\sid="([^"]*)"', text)
    assert len(ids) == len(set(ids))


@pytest.mark.exam
def test_a_refusal_and_a_refutation_are_told(page):
    again = recertified(2e-3, 1e-4)
    assert "With them: it has memory" in page(recertified={"before": again["before"], "after": {"refused": "it has memory"}})
    again["after"]["audit"]["violations"] = 3
    refuted = page(recertified=again | {"after": again["after"] | {"audit": {"points": 14502, "violations": 3}}})
    assert "With them: Refuted: at 3 of 14,502 fresh points" in refuted
    assert "smaller γ" not in refuted


@pytest.mark.exam
def test_no_answer_is_called_a_cause_that_is_none(page):
    assert "Causes that were named" in page()
    rest = {
        "needs_memory": False, "where": [[2.4, 2.7]],
        "looks_like": {"static": 0.5},
        "correction": {"site": "joint2", "kind": "basis", "terms": {"joint2_dot": -0.2}, "explained": 0.5},
    }  # fmt: skip
    text = page(verdict="unexplained", unexplained=rest, pushes=[PUSH])
    assert "Causes that were named" not in text
    for part in ("none of it is shown to be the cause", "2.4 to 2.7 s", "2.500 s", "not a cause; it predicts 50 %"):
        assert part in text
    assert "What naming the causes bought" not in page(verdict="nothing", causes=[])
    assert "Why is it wrong?" not in page(verdict="nothing", causes=[])


def test_hostile_names_are_escaped(page):
    bad = "<script>alert(1)</script>"
    text = page(causes=[COULOMB | {"site": bad, "flags": [bad]}], log={bad: bad}, evidence={bad: {bad: 1.0}}, equations=bad)
    assert "<script>alert" not in text
    assert text.count("<script>") == 1


def test_the_viewer_gets_the_same_answer():
    text = markdown(FOUND | {"name": "d"})
    assert text.startswith("# d: causes\n\nThe simulation lacks Coulomb friction")
    assert "| Coulomb friction at joint2 | level | 0.1312 N·m | 0.1272 to 0.1352 | 75.2 % |" in text
