"""Every way in which a spec can be wrong: one sentence, at its line and column, with what to do."""

import random

import pytest
from pydantic import BaseModel

from gapcert import GapcertError, MissingDependency, SpecError, load_spec
from gapcert.spec.models import validate
from gapcert.spec.source import Problem

# what is replaced, by what (‸ marks where the error stands), or line:column, the sentence, the hint
BROKEN = {
    "unknown section": ("sampling:", "‸smapling:", "", "smapling: unknown key 'smapling'", "did you mean 'sampling'?"),
    "unknown kind": (
        "kind: pybullet",
        "kind: ‸pybulet",
        "",
        "backend.kind: no plugin provides backend 'pybulet'",
        "did you mean 'pybullet'? (installed:",
    ),
    "kind of an extra": (
        "kind: envelope",
        "kind: ‸basis",
        "",
        "gap.kind: no plugin provides gap family 'basis'",
        "install it: pip install 'gapcert[basis]'",
    ),
    "kind missing": (
        "{kind: envelope, predictor",
        "{predictor",
        "12:1",
        "gap: missing required key 'kind'",
        "kinds: coded, constant, envelope",
    ),
    "kind is a number": ("kind: envelope", "kind: ‸3", "", "gap.kind: found 3; expected a name", "kinds: coded"),
    "section is text": (
        "gap: {kind: envelope, predictor: affine}",
        "gap: ‸envelope",
        "",
        "gap: found 'envelope'; expected a mapping with kind: coded | constant | envelope",
        "",
    ),
    "unknown option": (
        "fixed_base: true",
        "‸fixed_bas: true",
        "",
        "backend.fixed_bas: unknown key 'fixed_bas'",
        "did you mean 'fixed_base'?",
    ),
    "option missing": ("fixed_base: true, ", "", "8:1", "backend: missing required key 'fixed_base'", "add fixed_base:"),
    "unknown nested option": (
        "unit: rad, kind",
        "‸unti: rad, kind",
        "",
        "model.states.theta.unti: unknown key 'unti'",
        "did you mean 'unit'?",
    ),
    "loose plugin": (
        "{kind: envelope, predictor: affine}",
        "{kind: loose, ‸rat: 2}",
        "",
        "gap.rat: unknown key 'rat'",
        "did you mean 'rate'?",
    ),
    "wrong choice": (
        "predictor: affine",
        "predictor: ‸afine",
        "",
        "gap.predictor: found 'afine'; expected 'none' or 'affine' or a mapping",
        "did you mean 'affine'?",
    ),
    "wrong inner type": (
        "predictor: affine",
        "predictor: {model: ‸3}",
        "",
        "gap.predictor.model: found 3; expected a path",
        "",
    ),
    "wrong type": ("budget: 300", "budget: ‸many", "", "sampling.budget: found 'many'; expected a whole number", ""),
    "too small": ("budget: 300", "budget: ‸0", "", "sampling.budget: found 0; expected greater than or equal to 1", ""),
    "truth for a number": ("budget: 300", "budget: ‸true", "", "sampling.budget: found true; expected a whole number", ""),
    "list for a mapping": (
        "{theta: 200, omega: 200}",
        "‸[200, 200]",
        "",
        "controller.cells: found a list; expected a mapping",
        "",
    ),
    "version": ("version: 1", "version: ‸2", "", "version: found 2; expected 1", ""),
    "version missing": ("version: 1\n", "‸", "", "missing required key 'version'", "add version:"),
    "name": (
        "name: pendulum",
        "name: ‸My Pendulum",
        "",
        "name: found 'My Pendulum'; expected lower-case letters, digits, - and _",
        "",
    ),
    "unit does not fit": (
        "theta: [-0.2, 0.2], o",
        "theta: [‸-0.2 rad/s, 0.2], o",
        "",
        "domain.theta[0]: unit 'rad/s' does not fit; expected rad",
        "",
    ),
    "unknown unit": ("torque: [-1, 1]", "torque: [-1, ‸1 Nn]", "", "domain.torque[1]: unknown unit 'Nn'; expected N*m", ""),
    "no quantity": (
        "torque: [-1, 1]",
        "torque: [‸low, 1]",
        "",
        "domain.torque[0]: found 'low'; expected a number or a quantity in N*m",
        "",
    ),
    "bound is a mapping": (
        "torque: [-1, 1]",
        "torque: [‸{}, 1]",
        "",
        "domain.torque[0]: found a mapping; expected a number or a quantity such as '0.2 rad'",
        "",
    ),
    "three bounds": ("torque: [-1, 1]", "torque: ‸[-1, 0, 1]", "", "domain.torque: found 3 items; expected at most 2", ""),
    "empty box": (
        "torque: [-1, 1]",
        "torque: ‸[1, 1]",
        "",
        "domain.torque: [1, 1] is empty; expected [low, high] with low < high",
        "",
    ),
    "inverted box": ("torque: [-1, 1]", "torque: ‸[1 N*m, -1 N*m]", "", "domain.torque: [1 N*m, -1 N*m] is inverted", ""),
    "nan": ("torque: [-1, 1]", "torque: [-1, ‸.nan]", "", "domain.torque[1]: found .nan; expected a finite number", ""),
    "infinity": ("safety: 1.2", "safety: ‸.inf", "", "lipschitz.residual.safety: found .inf; expected a finite number", ""),
    "unknown state": (
        "torque: [-1, 1]",
        "‸torq: [-1, 1]",
        "",
        "domain.torq: unknown state or input 'torq'",
        "did you mean 'torque'?",
    ),
    "state missing": (
        ", torque: [-1, 1]",
        "",
        "9:1",
        "domain: nothing for 'torque'; every one of the model's states and inputs is needed",
        "add torque:",
    ),
    "backend state": (
        "{theta: hinge.position",
        "{‸phi: hinge.position",
        "",
        "backend.states.phi: unknown state or input 'phi'",
        "known: omega, theta",
    ),
    "goal outside": (
        "{theta: [0, 0.2], omega",
        "{theta: ‸[0, 0.3], omega",
        "",
        "controller.goal.invariance.theta: [0, 0.3] is outside the domain [-0.2, 0.2]",
        "shrink it, or widen domain:",
    ),
    "goal in wrong unit": (
        "{theta: [0, 0.2], omega",
        "{theta: [0, 10 deg], omega: [0, ‸1 m], x",
        "",
        "controller.goal.invariance.omega[1]: unit 'm' does not fit; expected rad/s",
        "",
    ),
    "goal about an input": (
        "{theta: [0, 0.2], omega: [-0.25, 0.25]}",
        "{‸torque: [0, 1]}",
        "",
        "controller.goal.invariance.torque: 'torque' is an input",
        "",
    ),
    "two goals": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "‸{reach: {theta: [0, 0.1]}, invariance: {theta: [0, 0.2]}}",
        "",
        "controller.goal: expected exactly one of invariance, reach, reach_avoid, reach_and_stay, recurrence, ltl, automaton",
        "",
    ),
    "unknown part of a goal": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{recurrence: {target: {theta: [0, 0.1]}, ‸start: {theta: [0, 0.2]}}}",
        "",
        "controller.goal.recurrence.start: unknown key 'start'",
        "did you mean 'target'?",
    ),
    "malformed cut": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{reach: {box: {theta: [0, 0.1]}, where: [‸phi <= 1]}}",
        "",
        "controller.goal.reach.where[0]: unknown name 'phi'",
        "",
    ),
    "radius without a centre": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{reach: [{centre: {theta: 0}, radii: {theta: 0.1, ‸omega: 0.1}}]}",
        "",
        "controller.goal.reach[0].radii.omega: 'omega' is not in centre",
        "name the same states in centre",
    ),
    "radius that is none": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{reach: {centre: {theta: 0}, radii: {theta: ‸-1 deg}}}",
        "",
        "controller.goal.reach.radii.theta: found -0.0174533; expected a positive radius",
        "",
    ),
    "formula of another kind": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{ltl: ‸F G a, regions: {a: {theta: [0, 0.1]}}}",
        "",
        "controller.goal.ltl: 'F G a' asks for something to hold for ever (G) from a moment on",
        "",
    ),
    "formula without its region": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{ltl: ‸F home, regions: {hole: {theta: [0, 0.1]}}}",
        "",
        "controller.goal.ltl: no region 'home'",
        "did you mean 'hole'?",
    ),
    "region that nothing reads": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{ltl: F a, regions: {a: {theta: [0, 0.1]}, ‸b: {theta: [0, 0.1]}}}",
        "",
        "controller.goal.regions.b: region 'b' is not in the formula",
        "known: a",
    ),
    "automaton without a file": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "{automaton: ‸word.hoa, regions: {a: {theta: [0, 0.1]}}}",
        "",
        "controller.goal.automaton: no file 'word.hoa'",
        "relative to the spec",
    ),
    "regions without a formula": (
        "{invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}",
        "‸{reach: {theta: [0, 0.1]}, regions: {a: {theta: [0, 0.1]}}}",
        "",
        "controller.goal: regions are needed with ltl or automaton",
        "",
    ),
    "no goal": (
        "goal: {invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}, ",
        "",
        "14:1",
        "controller: missing required key 'goal'",
        "add goal:",
    ),
    "claim too strong": (
        "claim: statistical",
        "claim: ‸deterministic",
        "",
        "certificate.claim: lipschitz.residual 'wood-zhang' cannot give a deterministic claim, statistical at most",
        "use claim: statistical, or another lipschitz.residual",
    ),
    "theorem 1 without cover": (
        "claim: statistical",
        "claim: statistical, route: ‸theorem1",
        "",
        "certificate.route: theorem1 needs a cover of known radius",
        "use sampling: {kind: grid",
    ),
    "confidence in percent": (
        "confidence: 0.999999",
        "confidence: ‸99",
        "",
        "certificate.confidence: found 99; expected less than 1",
        "",
    ),
    "controller without certificate": (
        "certificate: {claim: statistical, violation: 1e-3, confidence: 0.999999}\n",
        "‸",
        "",
        "controller: 'controller' needs 'certificate', which is missing",
        "add certificate:",
    ),
    "domain forgotten": (
        "domain: {theta: [-0.2, 0.2], omega: [-0.25, 0.25], torque: [-1, 1]}\n",
        "",
        "12:1",
        "certificate: 'certificate' needs 'domain', which is missing",
        "add domain:",
    ),
    "grid without counts": (
        "{kind: adaptive, budget: 300}",
        "‸{kind: grid}",
        "",
        "sampling: expected either `counts: {axis: cells}` or `radius:",
        "",
    ),
    "grid of an unknown axis": (
        "{kind: adaptive, budget: 300}",
        "{kind: grid, counts: {theta: 9, omega: 9, ‸tork: 5, torque: 5}}",
        "",
        "sampling.counts.tork: unknown state or input 'tork'",
        "did you mean 'torque'?",
    ),
    "unknown sampling": (
        "kind: adaptive",
        "kind: ‸adaptiv",
        "",
        "sampling.kind: found 'adaptiv'; expected adaptive or grid",
        "did you mean 'adaptive'?",
    ),
    "unknown executor": (
        "budget: 300",
        "budget: 300, executor: ‸proceses",
        "",
        "sampling.executor: no plugin provides executor 'proceses'",
        "did you mean 'processes'?",
    ),
    "unknown target of a constant": (
        "residual:",
        "‸residuel:",
        "",
        "lipschitz.residuel: unknown key 'residuel'",
        "did you mean 'residual'?",
    ),
    "deterministic from nothing": (
        "lipschitz: {residual: {kind: wood-zhang, safety: 1.2}}\n"
        "gap: {kind: envelope, predictor: affine}\n"
        "certificate: {claim: statistical",
        "certificate: {claim: ‸deterministic",
        "",
        "certificate.claim: a deterministic claim needs constants that are no estimates",
        "add lipschitz: {residual: {kind: interval}}",
    ),
    "no robot file": ("rod.urdf", "‸rood.urdf", "", "backend.robot: no file 'rood.urdf'", "did you mean 'rod.urdf'?"),
    "expression": ("sin(theta)", "‸foo(theta)", "", "model.derivative.omega: unknown name 'foo'", ""),
    "component's own refusal": (
        "  kind: equations",
        "  kind: picky",
        "5:3",
        "model.states: unknown key 'states'",
        "known: kind",
    ),
    "options that cannot be read": (
        "  kind: equations",
        "  kind: ‸broken",
        "",
        "model.kind: the options of 'broken' cannot be read (AttributeError:",
        "see `gapcert plugins`",
    ),
    "expect operator": (
        'tightness <="',
        'tightness =<"',
        "16:26",
        "unknown operator '=<'; expected one of == != <= >= < >",
        "",
    ),
    "expect path": (
        "certificate.states.*.t",
        "certificate..states.t",
        "16:26",
        "'certificate..states.tightness' has an empty part",
        "",
    ),
    "expect text": ('<=": 1.02', '<=": tight', "16:26", "'<=' compares numbers; found 'tight'", ""),
    "expect list": (
        'expect: {verdict: holds, "certificate.states.*.tightness <=": 1.02}',
        "expect: ‸[holds]",
        "",
        "expect: found a list; expected a mapping",
        "",
    ),
    "cells missing": (
        "cells: {theta: 200, omega: 200}",
        "cells: {theta: 200}",
        "14:91",
        "controller.cells: nothing for 'omega'; every one of the model's states is needed (theta, omega)",
        "add omega:",
    ),
    "cells unknown": (
        "cells: {theta: 200, omega: 200}",
        "cells: {theta: 200, omega: 200, ‸tetha: 3}",
        "",
        "controller.cells.tetha: unknown state or input 'tetha'",
        "did you mean 'theta'?",
    ),
    "inputs unknown": (
        "omega: 200}}",
        "omega: 200}, inputs: {torque: 3, ‸toque: 3}}",
        "",
        "controller.inputs.toque: unknown state or input 'toque'",
        "did you mean 'torque'?",
    ),
    "policy": (
        "starts: 100",
        "policies: [first, ‸best]",
        "",
        "closed_loop.policies[1]: found 'best'; expected 'first', 'middle', 'last', 'random', 'least-effort' or 'adversarial'",
        "",
    ),
    "duplicate key": (
        "name: pendulum",
        "name: pendulum\n‸name: other",
        "",
        "name: duplicate key 'name'",
        "first given in line 2",
    ),
    "merge key": (
        "name: pendulum",
        "name: pendulum\n‸<<: {seed: 1}",
        "",
        "<<: YAML 1.2 has no merge key '<<'",
        "write its keys out; a spec that builds on another names it under `extends:`",
    ),
    "tag": (
        "predictor: affine",
        "predictor: ‸!!python/name:os.system x",
        "",
        "gap.predictor: the tag '!!python/name:os.system' is not allowed",
        "",
    ),
    "not YAML": (
        "budget: 300}",
        "budget: 300",
        "11:10",
        "not YAML: expected ',' or '}', but got",
        "put a comma before it, or close with } what was opened in line 10",
    ),
    "brackets in a name": (
        "expect: {",
        "recording: {columns: {theta: Arm angle ‸[deg]}}\nexpect: {",
        "",
        "not YAML: expected ',' or '}', but got '['",
        "put quotes around a name that has brackets in it",
    ),
    "tab": ("  kind: equations", "‸\tkind: equations", "", "not YAML: found character", "indent with spaces"),
    "unknown alias": ("name: pendulum", "name: ‸*base", "", "not YAML: found undefined alias", ""),
    "extends nothing": (
        "version: 1",
        "version: 1\nextends: ‸bass.yaml",
        "",
        "extends: no file 'bass.yaml'",
        "paths are relative to the spec",
    ),
    "extends itself": (
        "version: 1",
        "version: 1\nextends: ‸pendulum.yaml",
        "",
        "extends: 'pendulum.yaml' extends this file",
        "break the circle",
    ),
    "matrix": (
        "version: 1",
        "version: 1\nmatrix: {gap.kind: ‸envelope}",
        "",
        "matrix.gap.kind: expected a list of at least one value",
        "",
    ),
    "matrix value": (
        "version: 1",
        "version: 1\nmatrix: {gap.predictor: [none, ‸afine]}",
        "",
        "gap.predictor: found 'afine'",
        "did you mean 'affine'?",
    ),
    "unknown section that is near nothing": (
        "gap: {kind",
        "‸extra: {kind",
        "",
        "extra: unknown key 'extra'",
        "known: backend, certificate, closed_loop",
    ),
}

BROKEN_DIAGNOSES = {
    "unknown effect": (
        "effects: all",
        "effects: [‸viscous-friktion]",
        "",
        "diagnose.effects[0]: no plugin provides effect 'viscous-friktion'",
        "did you mean 'viscous-friction'?",
    ),
    "hold-out": (
        "last: 33 %",
        "last: ‸133 %",
        "",
        "diagnose.hold_out.last: found '133 %'; expected a share between 0 and 1",
        "",
    ),
    "hold-out without every": (
        "{last: 33 %}",
        "‸{first: 2}",
        "",
        "diagnose.hold_out: expected one of `last: 33 %`, `from: 10 s` with `to: 20 s`, `trajectories: [...]` and `every: 5`",
        "",
    ),
    "train": (
        "hold_out: {last: 33 %}",
        "train: ‸{first: 2}, hold_out: {last: 33 %}",
        "",
        "diagnose.train: expected `every: 2`, with `first: 1` or without, or `trajectories: [...]`",
        "",
    ),
    "horizon": ("0.5 s", "‸0.5 m", "", "diagnose.horizons[0]: unit 'm' does not fit; expected s", ""),
    "negative horizon": ("0.5 s", "‸-0.5 s", "", "diagnose.horizons[0]: found '-0.5 s'; expected a positive time", ""),
    "no recording file": ("a.csv", "‸a.cvs", "", "recording.files[0]: no file 'a.cvs'", "did you mean 'a.csv'?"),
    "another recording file": ("a.csv", "‸b.csv", "", "recording.files[0]: no file 'b.csv'", "paths are relative to the spec"),
    "recording without diagnose": (
        "diagnose: {effects: all, hold_out: {last: 33 %}, horizons: [0.5 s, 7 s]}\n",
        "",
        "8:1",
        "recording: 'recording' needs 'diagnose', which is missing",
        "",
    ),
    "column is a list": ("{q: q, F: F}", "‸[q, F]", "", "recording.columns: found a list; expected a mapping", ""),
}


def spoil(text, row):
    """The text with the error in it, and where the error stands: line and column, from 1."""
    old, new, place = row[:3]
    assert text.count(old) == 1, f"'{old}' must stand once in the spec"
    text = text.replace(old, new)
    if place:
        line, column = map(int, place.split(":"))
    else:
        before = text.partition("‸")[0]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
    return text.replace("‸", ""), line, column


def check(folder, toys, name, text, row):
    text, line, column = spoil(text, row)
    message, hint = row[3:]
    (folder / name).write_text(text)
    with pytest.raises(SpecError) as caught:
        load_spec(folder / name, components=toys)
    report = str(caught.value).replace(f"{folder}/", "")
    blocks = [b for b in report.split(f"{name}:") if b.startswith(f"{line}:{column}: error: ") and message in b]
    assert len(blocks) == 1, f"no error at {line}:{column} '{message}' in\n{report}"
    head, shown, caret = blocks[0].splitlines()
    assert message in head
    assert shown == f"{line:>7} | {text.splitlines()[line - 1]}"
    assert caret.startswith(f"{'':>7} | {' ' * (column - 1)}^")
    assert hint in caret.partition("^")[2]
    assert "pydantic" not in report


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_certificate_spec(case, folder, toys, pendulum):
    check(folder, toys, "pendulum.yaml", pendulum, BROKEN[case])


@pytest.mark.parametrize("case", BROKEN_DIAGNOSES)
def test_a_broken_diagnosis_spec(case, folder, toys, drive):
    check(folder, toys, "drive.yaml", drive, BROKEN_DIAGNOSES[case])


SLIPS = {
    "tab": ("a:\n\tb: 1\n", "indent with spaces, not with tabs"),
    "no blank": ("a:\n  kind:csv\n  b: 1\n", "write a blank after the colon in line 2"),
    "no blank, last": ("name: x\nversion:1\n", "write a blank after the colon in line 2"),
    "no blank, braces": ("a: {q:m, b: 2}\n", "write a blank after the colon"),
    "colon in a text": ("a: this: that\n", "put quotes around a text that has a colon"),
    "bracket open": ("a: [1, 2\nb: 3\n", "close with ] what was opened in line 1"),
    "bracket too many": ("a: [1, 2]]\n", "it closes what was not opened"),
    "indented": ("a:\n  b: 1\n   c: 2\n", "indent it as the keys beside it"),
    "quote open": ("b: 1\na: 'text\n", "close the quote that was opened in line 2"),
    "apostrophe": ("a: 'it's'\n", "a quote within quotes is written twice"),
    "percent": ("a: %5\n", "put quotes around it"),
    "no value": ("a: 1\nb\nc: 2\n", "write key: value in line 2"),
    "a path is no slip": ("a:\n  path: C:/x\n   b: 1\n", "indent it as the keys"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_slip_in_yaml_says_what_to_do(toys, slip):
    text, hint = SLIPS[slip]
    with pytest.raises(SpecError) as error:
        load_spec(text, components=toys)
    assert hint in str(error.value)


def test_a_mistyped_key_is_told_once(folder, toys, drive):
    (folder / "drive.yaml").write_text(drive.replace("hold_out:", "holdout:").replace("diagnose:", "diagnosis:"))
    with pytest.raises(SpecError) as error:
        load_spec(folder / "drive.yaml", components=toys)
    assert "did you mean 'diagnose'?" in str(error.value)
    assert "needs 'diagnose'" not in str(error.value)
    (folder / "drive.yaml").write_text(drive.replace("hold_out:", "holdout:"))
    with pytest.raises(SpecError) as error:
        load_spec(folder / "drive.yaml", components=toys)
    assert [p["hint"] for p in error.value.problems] == ["did you mean 'hold_out'?"]


def test_a_domain_upside_down_judges_no_goal(folder, toys, pendulum):
    text = pendulum.replace("domain: {theta: [-0.2, 0.2]", "domain: {theta: [0.2, -0.2]")
    with pytest.raises(SpecError) as error:
        load_spec(text, components=toys)
    assert "[0.2, -0.2] is inverted" in str(error.value)
    assert "outside the domain" not in str(error.value)


def test_a_file_of_another_name_is_not_suggested(folder, toys):
    (folder / "m2e.yaml").write_text("version: 1\n")
    with pytest.raises(SpecError, match=r"nope\.yaml: error: no such file; give the path"):
        load_spec(folder / "nope.yaml", components=toys)


def test_the_table_is_long_enough():
    assert len(BROKEN) + len(BROKEN_DIAGNOSES) >= 40


def test_all_errors_of_a_file_come_in_one_pass_in_order(folder, toys, pendulum):
    text = pendulum
    for case in ("unknown kind", "nan", "too small", "infinity", "claim too strong", "expect operator", "name"):
        text = spoil(text, BROKEN[case])[0]
    (folder / "pendulum.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        load_spec("pendulum.yaml", components=toys)
    places = [(p["line"], p["column"]) for p in caught.value.problems]
    assert places == sorted(places)
    assert [line for line, _ in places] == [2, 8, 9, 10, 11, 13, 16]


def test_all_keys_that_are_missing_are_told_and_those_of_one_branch_alone():
    class Round(BaseModel):
        centre: float
        radius: float

    class Box(BaseModel):
        low: float
        high: float

    class Region(BaseModel):
        shape: Round | Box
        name: str
        unit: str

    problems: list[Problem] = []
    validate(Region, {"shape": {}}, ("region",), problems)
    told = [(p.path, p.hint) for p in problems]
    assert told == [
        (("region", "shape"), "add centre:"), (("region", "shape"), "add radius:"),
        (("region",), "add name:"), (("region",), "add unit:"),
    ]  # fmt: skip


def test_a_spec_must_ask_for_something(folder, toys, pendulum):
    text = "".join(line for line in pendulum.splitlines(True) if line.startswith(("version", "name")))
    part = load_spec(text, components=toys)
    with pytest.raises(SpecError, match=r"(?s)<text>:1:1: error: nothing to do.*add certificate: \(how wrong\?\) or diagnose:"):
        part.task  # noqa: B018
    model = load_spec(pendulum[: pendulum.index("backend:")], components=toys)
    with pytest.raises(SpecError, match=r"it has a model only: a spec that `extends:` it and adds `recording:`"):
        model.task  # noqa: B018


def test_a_missing_dependency_is_told_with_its_install_line_and_exit_code_3(folder, toys, pendulum):
    lines = [line for line in pendulum.splitlines() if not line.startswith("backend")]
    (folder / "pendulum.yaml").write_text("\n".join([*lines, "backend: {kind: absent}"]))
    with pytest.raises(MissingDependency) as caught:
        load_spec("pendulum.yaml", components=toys)
    assert caught.value.exit_code == 3
    assert "backend 'absent' needs no_such_engine, which is not installed" in str(caught.value)
    assert "^ pip install 'gapcert[absent]'" in str(caught.value)


def test_spec_errors_outrank_a_missing_dependency_but_both_are_told(folder, toys, pendulum):
    text = pendulum.replace("budget: 300", "budget: 300, executor: far")
    (folder / "pendulum.yaml").write_text(text.replace("steps: 600", "steps: 0"))
    with pytest.raises(SpecError) as caught:
        load_spec("pendulum.yaml", components=toys)
    assert "executor 'far' needs no_such_engine" in str(caught.value)
    assert "closed_loop.steps" in str(caught.value)


def test_an_offset_in_a_block_scalar_points_into_its_lines(folder, toys, pendulum):
    text = pendulum.replace(
        "  derivative: {theta: omega, omega: -3*9.81/2*sin(theta) + 3*torque}",
        "  derivative:\n    theta: omega\n    omega: |\n      1 + 2\n      + foo(theta)",
    )
    with pytest.raises(SpecError) as caught:
        load_spec(text, components=toys)
    assert "<text>:11:9: error: model.derivative.omega: unknown name 'foo'" in str(caught.value)


def test_an_offset_in_a_quoted_scalar_counts_from_the_quote(toys, folder, pendulum):
    text = pendulum.replace("-3*9.81/2*sin(theta) + 3*torque", '" foo(theta)"')
    with pytest.raises(SpecError, match="<text>:7:39: error"):
        load_spec(text, components=toys)


def test_an_override_is_blamed_on_the_command_line(folder, toys):
    with pytest.raises(SpecError) as caught:
        load_spec("pendulum.yaml", ["gap.predictor=afine"], components=toys)
    assert "--set:1:15: error: gap.predictor: found 'afine'" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"), [("gap.predictor", "path.to.key=value"), ("name.x=1", "leads through a value"), ("a=[1", "not YAML")]
)
def test_a_malformed_override(folder, toys, text, words):
    with pytest.raises(SpecError, match=words):
        load_spec("pendulum.yaml", [text], components=toys)


def test_files_that_are_no_specs(folder, toys):
    (folder / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    (folder / "empty.yaml").write_text("# nothing\n")
    (folder / "list.yaml").write_text("- 1\n- 2\n")
    for name, words in {
        "pendulun.yaml": "no such file; did you mean 'pendulum.yaml'",
        "binary.yaml": "byte 0 is not UTF-8",
        "empty.yaml": "found nothing; expected a mapping",
        "list.yaml": "found a list; expected a mapping",
        ".": "give the path of a spec",
    }.items():
        with pytest.raises(SpecError, match=words):
            load_spec(name, components=toys)


def test_an_error_in_an_extended_file_is_shown_there(folder, toys):
    (folder / "child.yaml").write_text("extends: pendulum.yaml\nname: child\n")
    (folder / "pendulum.yaml").write_text((folder / "pendulum.yaml").read_text().replace("affine", "afine"))
    with pytest.raises(SpecError, match=r"^pendulum\.yaml:12:34: error: gap\.predictor"):
        load_spec("child.yaml", components=toys)


def test_python_data_has_no_lines_but_the_same_sentences(folder, toys):
    from ruamel.yaml import YAML

    data = YAML(typ="safe").load((folder / "pendulum.yaml").read_text())
    data["domain"]["theta"] = [0.2, float("nan")]
    data["gap"]["kind"] = {1, 2}
    with pytest.raises(SpecError) as caught:
        load_spec(data, components=toys)
    assert "spec: error: domain.theta[1]: found nan; expected a finite number" in str(caught.value)
    assert "spec: error: gap.kind: found a set; expected plain data" in str(caught.value)


JUNK = [
    "",
    "{",
    "]",
    ": ",
    "- ",
    "null",
    "[]",
    "{}",
    "-1",
    "1e400",
    "'",
    "\t",
    "é",
    "&a ",
    "*a",
    "<<: ",
    "!!set ",
    "true",
    "\n",
    "  ",
    "|",
    "\x00",
]


@pytest.mark.parametrize("seed", range(100))
def test_whatever_is_typed_the_answer_is_a_sentence(seed, folder, toys, pendulum, drive):
    rng = random.Random(seed)
    text = rng.choice([pendulum, drive])
    for _ in range(rng.randint(1, 3)):
        start = rng.randrange(len(text))
        text = text[:start] + rng.choice(JUNK) + text[start + rng.choice([0, 0, 1, 5, 20]) :]
    (folder / "typed.yaml").write_text(text)
    report = "typed.yaml"
    try:
        load_spec("typed.yaml", components=toys)
    except GapcertError as error:
        report = str(error)
    assert report.startswith("typed.yaml")
    assert "pydantic" not in report
