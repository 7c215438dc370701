"""The schema is installed where editors look, and helps in the real language server: kinds, options, units, hover, typos."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from yaml_server import Server

from gapcert.cli.main import main
from gapcert.spec import editor
from gapcert_scaffold.scaffold import scaffold

ROOT = Path(__file__).parents[2]
SPECS = sorted((ROOT / "specs").rglob("*.yaml"))
HEAD = "version: 1\nname: some\n"
NAMES = (f"specs/some{k}.yaml" for k in itertools.count())


def install(folder, *more):
    return main(["schema", "--install", str(folder), *more])


def settings(folder):
    return json.loads((folder / ".vscode/settings.json").read_text())


# --- where editors look


def test_schema_and_settings_are_installed(tmp_path, capsys):
    assert install(tmp_path) == 0
    assert json.loads((tmp_path / ".gapcert/spec.schema.json").read_text())["title"] == "Gapcert spec"
    assert settings(tmp_path) == {"yaml.schemas": {"./.gapcert/spec.schema.json": ["**/*.gapcert.yaml", "specs/**/*.yaml"]}}
    assert "# yaml-language-server: $schema=" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["settings.json", "spec.schema.json"]


def test_what_the_user_has_stays(tmp_path):
    (tmp_path / ".vscode").mkdir()
    own = {"editor.fontSize": 13, "yaml.schemas": {"k8s.json": "k8s/*", "./.gapcert/spec.schema.json": "mine/*.yaml"}}
    (tmp_path / ".vscode/settings.json").write_text(json.dumps(own))
    assert install(tmp_path) == 0
    found = settings(tmp_path)
    assert list(found) == list(own)
    assert found["yaml.schemas"]["k8s.json"] == "k8s/*"
    assert "mine/*.yaml" in found["yaml.schemas"]["./.gapcert/spec.schema.json"]
    before = (tmp_path / ".vscode/settings.json").read_bytes()
    assert install(tmp_path) == 0
    assert (tmp_path / ".vscode/settings.json").read_bytes() == before


def test_settings_keep_their_indentation_and_dead_links_are_passed_over(tmp_path):
    (tmp_path / ".vscode").mkdir()
    (tmp_path / ".vscode/settings.json").write_text('{\n\t"editor.fontSize": 13\n}\n')
    (tmp_path / "dead.yaml").symlink_to(tmp_path / "nowhere.yaml")
    assert install(tmp_path) == 0
    assert '\n\t"yaml.schemas": {\n\t\t"' in (tmp_path / ".vscode/settings.json").read_text()


def test_settings_with_comments_are_left_alone(tmp_path, capsys):
    (tmp_path / ".vscode").mkdir()
    text = '{\n  // my font\n  "editor.fontSize": 13,\n}\n'
    (tmp_path / ".vscode/settings.json").write_text(text)
    assert install(tmp_path) == 0
    assert (tmp_path / ".vscode/settings.json").read_text() == text
    assert 'add to it: "yaml.schemas": {"./.gapcert/spec.schema.json":' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "reason"), [("{", "is not JSON"), ("[]", "expected an object"), ('{"yaml.schemas": 1}', "mend it")]
)
def test_broken_settings_are_named_and_nothing_is_written(tmp_path, capsys, text, reason):
    (tmp_path / ".vscode").mkdir()
    (tmp_path / ".vscode/settings.json").write_text(text)
    assert install(tmp_path) == 2
    assert reason in capsys.readouterr().err
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["settings.json"]


def test_specs_elsewhere_are_found_and_other_yaml_is_not(tmp_path, capsys):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot/arm.yaml").write_text(HEAD)
    (tmp_path / "compose.yaml").write_text("services: {}\n")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/extended.yaml").write_text(HEAD)
    assert install(tmp_path, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["match"] == ["**/*.gapcert.yaml", "robot/arm.yaml", "specs/**/*.yaml"]


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert install(tmp_path / "nowhere") == 2
    assert "there is no such folder" in capsys.readouterr().err


def test_a_modeline_is_put_once_and_changes_nothing_else(tmp_path, capsys):
    spec = tmp_path / "deep" / "a.yaml"
    spec.parent.mkdir()
    spec.write_bytes(b"# about\r\nversion: 1\r\nname: a\r\n")
    assert main(["schema", "--modeline", str(spec)]) == 2
    assert "run `gapcert schema --install FOLDER` first" in capsys.readouterr().err
    for _ in range(2):
        assert main(["schema", "--install", str(tmp_path), "--modeline", str(spec)]) == 0
        line = b"# yaml-language-server: $schema=../.gapcert/spec.schema.json\r\n"
        assert spec.read_bytes() == line + b"# about\r\nversion: 1\r\nname: a\r\n"


def test_a_write_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        editor.write(path, "new")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"a.json": "old"}


# --- in the real language server


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project with the schema installed, by a Python that has a third party's backend and effect."""
    folder, site = tmp_path_factory.mktemp("project"), tmp_path_factory.mktemp("site")
    for kind, name in (("backend", "our-cart"), ("effect", "our-grease")):
        made = scaffold(kind, name)
        made.write(site / made.distribution)
        info = site / made.distribution / f"{made.package}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {made.distribution}\nVersion: 0.1\n")
        (info / "entry_points.txt").write_text(f"[gapcert]\nown = {made.package}.plugin\n")
    path = os.pathsep.join([*map(str, sorted(site.iterdir())), *sys.path])
    command = [sys.executable, "-m", "gapcert", "schema", "--install", str(folder)]
    subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": path}, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def server(project):
    schemas = settings(project)["yaml.schemas"]
    made = Server(project, {"yaml": {"schemas": schemas, "validate": True, "completion": True, "hover": True}})
    yield made
    made.close()


def complete(server, text):
    return server.complete(next(NAMES), HEAD + text)


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "kinds"),
    [
        ("backend:\n  kind: |\n", {"mujoco", "pybullet", "equations", "our-cart"}),
        ("model: {kind: |}\n", {"equations", "engine", "python"}),
        ("gap:\n  kind: |\n", {"envelope", "constant", "basis"}),
        ("lipschitz:\n  residual:\n    kind: |\n", {"wood-zhang", "interval"}),
        ("controller:\n  kind: |\n", {"symbolic", "mpc"}),
        ("recording:\n  kind: |\n", {"csv", "mcap"}),
        ("sampling:\n  kind: |\n", {"grid", "adaptive", "lattice"}),
        ("sampling:\n  kind: grid\n  executor: |\n", {"processes", "threads", "dask"}),
        ("diagnose:\n  effects: [|]\n", {"coulomb-friction", "our-grease"}),
        ("model:\n  kind: engine\n  of:\n    kind: |\n", {"mujoco", "dart"}),
    ],
)
def test_kinds_and_names_are_completed(server, text, kinds):
    assert kinds <= set(complete(server, text))


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("|", {"model", "backend", "certificate", "expect", "diagnose"}),
        ("backend:\n  kind: our-cart\n  |\n", {"mass", "stiffness", "drag", "period"}),
        ("backend:\n  kind: mujoco\n  |\n", {"robot", "states", "inputs", "integrator"}),
        ("certificate:\n  |\n", {"claim", "violation", "route"}),
        ("controller:\n  kind: symbolic\n  goal:\n    |\n", {"invariance", "reach_avoid", "ltl"}),
        ("certificate:\n  claim: |\n", {"deterministic", "statistical", "empirical"}),
        ("model:\n  kind: equations\n  integrator: |\n", {"euler", "rk4"}),
        ("extends: other.yaml\nbackend:\n  kind: mujoco\n  |\n", {"robot", "tiles"}),
    ],
)
def test_options_and_their_values_are_completed(server, text, options):
    assert options <= set(complete(server, text))


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "units"),
    [
        ("model:\n  kind: equations\n  states:\n    theta: |\n", {"rad", "rad/s", "N*m", "m"}),
        ("model:\n  kind: equations\n  states:\n    theta:\n      unit: |\n", {"rad", "rad/s", "N*m", "m"}),
        ("model:\n  kind: equations\n  inputs:\n    u: |\n", {"N*m", "V"}),
        ("model:\n  kind: equations\n  parameters:\n    m: |\n", {"kg", "m/s^2"}),
        ("model:\n  kind: equations\n  period: |\n", {"ms", "s"}),
        ("diagnose:\n  window: |\n", {"ms", "s"}),
        ("backend:\n  kind: mujoco\n  period: |\n", {"ms", "s"}),
    ],
)
def test_units_are_offered(server, text, units):
    assert units <= set(complete(server, text))


@pytest.mark.exam
def test_a_unit_brings_its_number_to_be_typed_over(server):
    offered = complete(server, "model:\n  kind: equations\n  period: |\n")
    assert not {"N*m", "kg"} & set(offered)
    item = offered["ms"]
    assert (item.get("textEdit") or {}).get("newText", item["insertText"]) == "${1:5} ms"
    assert item["insertTextFormat"] == 2  # a snippet


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("back|end:\n  kind: mujoco\n", "simulator"),
        ("backend:\n  kind: our-|cart\n", "a mass on a spring in still air"),
        ("certificate:\n  claim: empirical\n  viola|tion: 1e-3\n", "ε"),
        ("backend:\n  kind: our-cart\n  dr|ag: 1\n", "of the air"),
        ("sampling:\n  kind: adaptive\n  bud|get: 100\n", "transitions, at most"),
    ],
)
def test_hover_says_what_it_is(server, text, words):
    assert words in server.hover(next(NAMES), HEAD + text)


@pytest.mark.exam
@pytest.mark.parametrize("spec", SPECS, ids=lambda p: p.relative_to(ROOT / "specs").as_posix())
def test_no_valid_spec_is_flagged(server, spec):
    assert server.diagnose(next(NAMES), spec.read_text()) == []


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("backend:\n  kind: mujocco\n", 4, "mujoco"),
        ("certificate:\n  claim: empirical\n  violaton: 1e-3\n", 5, "violaton"),
        ("gapp: {kind: envelope}\n", 3, "gapp"),
        ("gap:\n  kind: envelope\n  predictor: cubic\n", 5, "affine"),
        ("sampling: {kind: adaptive, budget: many}\n", 3, "integer"),
        ("certificate:\n  claim: certain\n", 4, "deterministic"),
        ("lipschitz:\n  residual:\n    kind: interval\n    boxes: 1.5\n", 6, "integer"),
        ("domain: {x: 1}\n", 3, "array"),
        ("diagnose:\n  effects: [coulomb-frictoin]\n  hold_out: {last: 25 %}\n  horizons: [1 s]\n", 4, "coulomb-friction"),
        ("backend:\n  kind: our-cart\n  mas: 1\n", 5, "mas"),
        ("extends: other.yaml\ncertificate:\n  violaton: 1e-3\n", 5, "violaton"),
    ],
)
def test_a_mistake_is_flagged_where_it_is(server, text, line, word):
    found = server.diagnose(next(NAMES), HEAD + text)
    assert any(at == line and word in said for at, said in found), found


@pytest.mark.exam
def test_a_modeline_is_enough(server, project):
    without, spec = project / "elsewhere" / "robot.yaml", project / "elsewhere" / "named.yaml"
    spec.parent.mkdir()
    for path in (without, spec):
        path.write_text(HEAD + "gapp: 1\n")
    editor.modeline(spec)
    assert server.diagnose("elsewhere/robot.yaml", without.read_text()) == []
    assert [line for line, _ in server.diagnose("elsewhere/named.yaml", spec.read_text())] == [4]
