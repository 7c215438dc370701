"""Specs: what they mean, how they are put together, what they expect of themselves, and their JSON Schema."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gapcert import Domain, MissingDependency, SpecError, StateSpec, UsageError, load_spec
from gapcert.contracts.data.units import magnitude
from gapcert.contracts.systems.domain import Box
from gapcert.spec.expect import evaluate_expectations, parse_key
from gapcert.spec.schema import schema
from gapcert.spec.spec import Spec


@pytest.fixture
def load(folder, toys):
    return lambda spec, *overrides: load_spec(spec, overrides, components=toys)


def add(folder, name, text):
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return name


# --- meaning


def test_sections_are_typed_and_boxes_are_in_the_models_units(load, pendulum):
    config = load(pendulum.replace("theta: [-0.2, 0.2], omega", "theta: [-90 deg, 0.2], omega")).config
    assert config.name == "pendulum"
    assert config.model.kind == "equations"
    assert config.domain["theta"] == (pytest.approx(-np.pi / 2), 0.2)
    assert config.lipschitz["residual"].safety == 1.2
    assert config.certificate.violation == 1e-3
    assert config.goal.invariance == {"theta": (0.0, 0.2), "omega": (-0.25, 0.25)}
    assert config.controller.cells == {"theta": 200, "omega": 200}
    assert config.sampling.chunk == 100_000
    assert config.report.html


def test_defaults_fill_what_a_spec_leaves_out(load, pendulum):
    kept = [
        s
        for s in pendulum.splitlines(True)
        if not s.startswith(("sampling", "lipschitz", "gap", "controller", "closed", "expect"))
    ]
    spec = load("".join(kept))
    assert spec.task == "certify"
    assert spec.config.sampling is None
    assert spec.config.seed == 0
    assert dict(spec.config.expect) == {}


def test_a_diagnosis_is_read_in_seconds_and_shares(load):
    spec = load("drive.yaml")
    assert spec.task == "diagnose"
    assert spec.config.sections["diagnose"].horizons == [0.5, 7.0]
    assert spec.config.sections["diagnose"].hold_out.last == pytest.approx(0.33)
    assert spec.config.recording.files == ["a.csv"]


def test_file_text_and_data_are_the_same_spec(load, folder, pendulum):
    one, two, three = load("pendulum.yaml"), load(pendulum), load(load("pendulum.yaml").data)
    assert one.digest == two.digest == three.digest
    assert one.path == Path("pendulum.yaml")
    assert two.path is None


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("no", "no"),
        ("012", 12),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("0o17", 15),
        ("true", True),
    ],
)
def test_scalars_are_those_of_yaml_1_2(load, text, value):
    spec = load("drive.yaml", f"expect.x={text}")
    assert spec.data["expect"]["x"] == value
    assert type(spec.data["expect"]["x"]) is type(value)


def test_aliases_and_flow_and_block_style_are_allowed(load, pendulum):
    text = pendulum.replace("omega: [-0.25, 0.25], torque", "omega: &w [-0.25, 0.25], torque").replace(
        "0.2], omega: [-0.25, 0.25]}}", "0.2], omega: *w}}"
    )
    assert load(text).config.goal.invariance["omega"] == (-0.25, 0.25)


def test_digest_tells_specs_and_the_files_they_name_apart(load, folder):
    first = load("pendulum.yaml")
    assert first.digest == load("pendulum.yaml").digest
    assert first.digest != load("pendulum.yaml", "seed=1").digest
    assert first.digest_of("model", "domain") == load("pendulum.yaml", "seed=1").digest_of("model", "domain")
    (folder / "rod.urdf").write_text("<robot name='other'/>")
    assert first.digest != load("pendulum.yaml").digest


def test_sections_build_their_components_with_a_context(folder, toys, monkeypatch):
    monkeypatch.setattr("gapcert.spec.spec.registry", lambda: toys)
    spec = load_spec("pendulum.yaml", ["seed=3"])
    family = spec.build("gap")
    assert family.config.predictor == "affine"
    assert (family.context.seed, family.context.folder, family.context.allow_code) == (3, Path(), False)
    assert spec.build("lipschitz.residual").config.kind == "wood-zhang"
    assert spec.component("backend").kind == "backend"


def test_a_component_that_runs_code_is_refused_unless_allowed(folder, toys, monkeypatch):
    monkeypatch.setattr("gapcert.spec.spec.registry", lambda: toys)
    spec = load_spec("pendulum.yaml", ["gap={kind: coded}"])
    with pytest.raises(UsageError, match="pass --allow-code"):
        spec.build("gap")
    assert spec.build("gap", allow_code=True).context.allow_code


def test_errors_that_only_a_run_finds_can_point_into_the_spec(load):
    assert str(load("drive.yaml").error("recording.columns", "no column 'q'", "columns: t, F")).startswith(
        "drive.yaml:8:58: error: recording.columns: no column 'q'"
    )


def test_goals_become_boxes_over_all_states(load):
    axes = (StateSpec("theta", "rad"), StateSpec("omega", "rad/s"))
    domain = Domain(Box(axes, (-0.2, -0.25), (0.2, 0.25)), Box((StateSpec("torque", "N*m"),), (-1.0,), (1.0,)))
    goal = load("pendulum.yaml", "controller.goal={invariance: {theta: [0, 0.1]}}").goal(domain)
    assert (goal.kind, goal.stay.low, goal.stay.high) == ("invariance", (0.0, -0.25), (0.1, 0.25))
    goal = load("pendulum.yaml", "controller.goal={reach: {theta: [0, 0.1]}}").goal(domain)
    assert (goal.kind, goal.stay, goal.target.boxes[0].high) == ("reach_avoid", domain.states, (0.1, 0.25))
    text = "{reach_avoid: {target: {theta: [0, 0.1]}, avoid: [{omega: [0.2, 0.4]}], stay: {theta: [-0.1, 0.2]}}}"
    goal = load("pendulum.yaml", f"controller.goal={text}").goal(domain)
    assert (goal.avoid.boxes[0].high, goal.stay.low) == ((0.2, 0.4), (-0.1, -0.25))


def test_goals_with_targets_of_several_shapes(load):
    axes = (StateSpec("theta", "rad"), StateSpec("omega", "rad/s"))
    domain = Domain(Box(axes, (-0.2, -0.25), (0.2, 0.25)), Box((StateSpec("torque", "N*m"),), (-1.0,), (1.0,)))
    ball = "{centre: {theta: 0.1, omega: 0 deg/s}, radii: {theta: 50 mrad, omega: 0.1}}"
    cut = '{box: {theta: [0, 0.1]}, where: ["abs(omega) <= 100 mrad/s"]}'
    text = f"{{recurrence: {{target: [{ball}, {cut}, {{theta: [-0.1, 0]}}], avoid: [{ball}], stay: {{theta: [-0.1, 0.2]}}}}}}"
    goal = load("pendulum.yaml", f"controller.goal={text}").goal(domain)
    assert (goal.kind, goal.stay.low) == ("recurrence", (-0.1, -0.25))
    assert (goal.target.boxes[0].high, goal.target.polytopes[0].box.low) == ((0.0, 0.25), (0.0, -0.25))
    x = np.array([[0.14, 0.0], [0.16, 0.0], [0.05, 0.09], [0.05, 0.11], [-0.05, 0.2]])
    assert goal.target.contains(x).tolist() == [True, False, True, False, True]
    assert goal.avoid.contains(x).tolist() == [True, False, False, False, False]
    again = load("pendulum.yaml", f"controller.goal={text.replace('recurrence', 'reach_and_stay')}").goal(domain)
    assert (again.kind, again.target, again.avoid) == ("reach_and_stay", goal.target, goal.avoid)


AUTOMATON = """HOA: v1 States: 1 Start: 0 AP: 1 "fast" Acceptance: 0 t --BODY-- State: 0 [!0] 0 --END--"""


def test_goals_of_words_over_regions(load, tmp_path):
    axes = (StateSpec("theta", "rad"), StateSpec("omega", "rad/s"))
    domain = Domain(Box(axes, (-0.2, -0.25), (0.2, 0.25)), Box((StateSpec("torque", "N*m"),), (-1.0,), (1.0,)))
    regions = "{left: {theta: [-0.2, -5 deg]}, right: [{theta: [0.1, 0.2]}, {centre: {theta: 0.1}, radii: {theta: 0.01}}]}"
    text = f"{{ltl: 'F (right & F left)', regions: {regions}, avoid: [{{omega: [0.2, 9]}}], stay: {{omega: [-0.2, 0.25]}}}}"
    goal = load("pendulum.yaml", f"controller.goal={text}").goal(domain)
    assert (goal.kind, goal.automaton.propositions, goal.stay.low) == ("automaton", ("right", "left"), (-0.2, -0.2))
    assert goal.letter(np.array([[0.15, 0.0], [0.0, 0.0], [-0.1, 0.0], [0.095, 0.0]])).tolist() == [1, 0, 2, 1]
    assert goal.avoid.contains(np.array([[0.0, 0.21]])).all()
    (tmp_path / "word.hoa").write_text(AUTOMATON)
    text = f"{{automaton: {tmp_path}/word.hoa, regions: {{fast: {{omega: [0.1, 0.25]}}}}}}"
    spec = load("pendulum.yaml", f"controller.goal={text}")
    assert spec.goal(domain).automaton.after == ((0, -1),)
    # The text of the automaton belongs to the spec: another one is another run.
    first = spec.digest
    (tmp_path / "word.hoa").write_text(AUTOMATON.replace("[!0]", "[0]"))
    assert load("pendulum.yaml", f"controller.goal={text}").digest != first
    (tmp_path / "word.hoa").write_text(AUTOMATON.replace("fast", "slow"))
    with pytest.raises(UsageError, match="the automaton reads 'slow', and there is no such region"):
        load("pendulum.yaml", f"controller.goal={text}").goal(domain)


def test_an_obstacle_may_stick_out_of_the_domain_but_not_miss_it(load):
    text = "controller.goal={{reach_avoid: {{target: {{theta: [0, 0.1]}}, avoid: [{{theta: {}}}]}}}}"
    load("pendulum.yaml", text.format("[0.1, 9]"))
    with pytest.raises(SpecError, match=r"avoid\[0\]\.theta: \[8, 9\] is outside the domain"):
        load("pendulum.yaml", text.format("[8, 9]"))


# --- units


@pytest.mark.parametrize(
    ("value", "unit", "number"),
    [
        (3, "rad", 3.0),
        ("3", "rad", 3.0),
        ("-0.2 rad", "rad", -0.2),
        ("180 deg", "rad", np.pi),
        ("5 ms", "s", 5e-3),
        ("1e2 cm", "m", 1.0),
        ("33 %", "1", 0.33),
    ],
)
def test_quantities(value, unit, number):
    assert magnitude(value, unit) == pytest.approx(number, rel=1e-15)


@pytest.mark.parametrize(
    "value", ["", "rad", "1 kg", "nan rad", "1e999", "1 m m m m m s", "__import__('os') rad", "1 rad; 2", True, None, []]
)
def test_what_is_no_quantity_in_radians(value):
    with pytest.raises(ValueError, match="expected"):
        magnitude(value, "rad")


# --- extends, --set, matrix


def test_extends_merges_deeply_and_replaces_sections_of_another_kind(load, folder):
    lines = [
        "extends: pendulum.yaml",
        "name: child",
        "sampling: {kind: grid, counts: {theta: 3, omega: 3, torque: 3}}",
        "domain: {theta: [-0.25, 0.25]}",
        "closed_loop: null",
    ]
    child = add(folder, "child.yaml", "\n".join(lines))
    spec = load(child)
    assert spec.name == "child"
    assert spec.data["sampling"] == {"kind": "grid", "counts": {"theta": 3, "omega": 3, "torque": 3}}
    assert spec.config.domain["theta"] == (-0.25, 0.25)
    assert spec.config.domain["torque"] == (-1.0, 1.0)
    assert "closed_loop" not in spec.config.sections
    assert "extends" not in spec.data


def test_paths_are_relative_to_the_file_that_names_them(load, folder, pendulum):
    add(folder, "base/models/rod.urdf", "<robot name='base'/>")
    add(folder, "base/base.yaml", pendulum.replace("rod.urdf", "models/rod.urdf"))
    add(folder, "studies/child.yaml", "extends: ../base/base.yaml\nname: child\n")
    spec = load("studies/child.yaml")
    assert spec.folder / spec.config.backend.robot == Path("studies/../base/models/rod.urdf")
    assert spec.data["backend"]["robot"] == "../base/models/rod.urdf"
    (folder / "base/models/rod.urdf").unlink()
    with pytest.raises(SpecError, match=r"^base/base\.yaml:8:34: error: backend\.robot: no file 'models/rod\.urdf'"):
        load("studies/child.yaml")


def test_overrides_are_yaml_and_reach_into_lists(load):
    spec = load("pendulum.yaml", "sampling.budget=7", "domain.theta[1]=0.3", "closed_loop.policies=[last]", "seed=5")
    assert (spec.config.sampling.budget, spec.config.domain["theta"], spec.config.seed) == (7, (-0.2, 0.3), 5)
    assert spec.config.sections["closed_loop"].policies == ["last"]
    assert load("pendulum.yaml", "report.html=false").config.report.html is False


def test_an_override_mends_a_broken_value(load, folder):
    (folder / "pendulum.yaml").write_text((folder / "pendulum.yaml").read_text().replace("budget: 300", "budget: .nan"))
    assert load("pendulum.yaml", "sampling.budget=7").config.sampling.budget == 7


def test_a_matrix_expands_to_specs_with_names_of_their_own(load, folder):
    text = (folder / "pendulum.yaml").read_text() + "matrix: {gap.predictor: [none, affine], sampling.budget: [100, 300]}\n"
    spec = load(text)
    assert spec.is_matrix
    assert [s.name for s in spec.expand()] == [f"pendulum-{p}-{b}" for p in ("none", "affine") for b in (100, 300)]
    assert [s.config.sampling.budget for s in spec.expand()] == [100, 300, 100, 300]
    assert spec.expand()[1].variant == {"gap.predictor": "none", "sampling.budget": 300}
    assert len({s.digest for s in spec.expand()}) == 4
    single = load("pendulum.yaml")
    assert single.expand() == (single,)
    assert not single.is_matrix


def test_members_of_a_matrix_that_read_alike_are_numbered(load, folder):
    text = (folder / "pendulum.yaml").read_text() + "matrix: {'domain.torque': [[-1, 1], [-1.0, 1]]}\n"
    assert [s.name for s in load(text).expand()] == ["pendulum-1-1", "pendulum-1-0-1"]


# --- expectations

SUMMARY = {
    "verdict": "holds",
    "certificate": {"states": {"theta": {"tightness": 1.01}, "omega": {"tightness": 1.03}}, "vacuous": False},
    "closed_loop": {"policies": [{"violations": 0}, {"violations": 2}]},
    "causes": [{"effect": "coulomb-friction"}, {"effect": "asymmetric-viscous-friction"}],
    "gain": {"0.5": {"q": {"after": 1e-3}}},
    "nothing": None,
    "empty": {},
}


@pytest.mark.parametrize(
    ("key", "wanted", "met", "value"),
    [
        ("verdict", "holds", True, "holds"),
        ("verdict !=", "holds", False, "holds"),
        ("certificate.states.theta.tightness <=", 1.02, True, 1.01),
        ("certificate.states.*.tightness <=", 1.02, False, [1.01, 1.03]),
        ("certificate.states.*.tightness <", 2, True, [1.01, 1.03]),
        ("certificate.states.*.missing", 1, False, [None, None]),
        ("certificate.vacuous", False, True, False),
        ("certificate.vacuous", 0, False, False),
        ("closed_loop.policies.1.violations >", 0, True, 2),
        ("closed_loop.policies.*.violations", 0, False, [0, 2]),
        ("causes", ["asymmetric-viscous-friction", "coulomb-friction"], True, SUMMARY["causes"]),
        ("causes", ["coulomb-friction"], False, SUMMARY["causes"]),
        ("causes", [], False, SUMMARY["causes"]),
        ("gain.0.5.q.after <", 1e-2, True, 1e-3),
        ("missing.path", 1, False, None),
        ("missing.path !=", 1, False, None),
        ("missing <=", 1, False, None),
        ("empty.*", 1, False, None),
        ("nothing <=", 1, False, None),
        ("verdict <=", 1, False, "holds"),
        ("verdict>=", 1, False, "holds"),
    ],
)
def test_expectations(key, wanted, met, value):
    (answer,) = evaluate_expectations({key: wanted}, SUMMARY)
    assert (answer["met"], answer["value"]) == (met, value)
    segments, symbol = parse_key(key)
    assert answer["text"].startswith(f"{'.'.join(segments)} {symbol} ")


def test_an_empty_list_of_causes_is_met_by_an_empty_list():
    assert evaluate_expectations({"causes": []}, {"causes": []})[0]["met"]


# --- schema


def test_the_schema_knows_every_installed_kind_and_requires_kind(toys):
    made = schema(toys)
    json.dumps(made)
    whole = made["else"]
    assert set(whole["required"]) == {"version", "name"}
    backend = whole["properties"]["backend"]
    assert set(backend["discriminator"]["mapping"]) >= {"pybullet", "equations"}
    for section in ("model", "backend", "gap", "controller", "recording", "sampling"):
        for option in whole["properties"][section]["oneOf"]:
            target = made["$defs"][option["$ref"].removeprefix("#/$defs/")]
            assert "kind" in target["required"]
    assert "goal" in made["$defs"]["controller.symbolic"]["properties"]


def test_every_reference_of_the_schema_leads_somewhere(toys):
    made = schema(toys)

    def references(node):
        if isinstance(node, dict):
            yield from (node[k] for k in ("$ref",) if k in node)
            yield from node.get("discriminator", {}).get("mapping", {}).values()
            for child in node.values():
                yield from references(child)
        elif isinstance(node, list):
            for child in node:
                yield from references(child)

    def there(reference):
        node = made
        for key in reference.removeprefix("#/").split("/"):
            node = node[key]
        return bool(node)

    found = list(references(made))
    assert found
    assert all(map(there, found))


# --- cost, and what a spec may do


@pytest.mark.contract
def test_validation_imports_no_engine_solver_torch_or_jax(folder, pendulum):
    add(
        folder,
        "real.yaml",
        pendulum.replace("  derivative", "  integrator: euler\n  period: 5 ms\n  derivative").replace(
            "-3*9.81/2*sin(theta) + 3*torque", "-sin(theta)*9.81/(1 s)^2"
        ),
    )
    code = (
        "import sys, gapcert as gc\n"
        "try: gc.load_spec('real.yaml')\n"
        "except gc.GapcertError as e: print(type(e).__name__)\n"
        "print(sorted({'pybullet', 'cvxpy', 'clarabel', 'torch', 'jax', 'numba', 'rerun', 'matplotlib'} & set(sys.modules)))\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=folder, env=os.environ)
    assert out.stdout.splitlines()[-1] == "[]"


def test_a_spec_is_data_and_nothing_in_it_is_run(load, pendulum, folder):
    for text in ("!!python/object/apply:os.mkdir [made]", "!!python/name:os.mkdir x"):
        with pytest.raises(SpecError, match="is not allowed"):
            load(pendulum.replace("predictor: affine", f"predictor: {text}"))
    assert not (folder / "made").exists()


def test_a_spec_is_frozen(load):
    spec = load("pendulum.yaml")
    assert isinstance(spec, Spec)
    with pytest.raises(AttributeError):
        spec.path = None
    with pytest.raises(MissingDependency):
        load("pendulum.yaml", "sampling.executor=far")


def test_units_have_parentheses_where_they_are_more_than_one_symbol():
    from gapcert.contracts.data.units import product

    assert product([("N*s", 1), ("m", -1), ("K", -2)]) == "N*s/m/K**2"
    assert product([("N", 1), ("rad/s", -1), ("m/s", 2)]) == "N*(m/s)**2/(rad/s)"
    assert product([]) == "1"
