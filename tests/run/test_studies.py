"""Studies, sections and commands of somebody else: found, carried out, and no harm where they are broken."""

import json

import knocking
import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert.contracts.plugins.registry import Registry, installed
from gapcert.plugin import Component
from gapcert.run.status import RunFolder
from gapcert.spec.schema import schema

MODEL = {"kind": "equations", "states": {"x": "1"}, "inputs": {"u": "1"}, "period": "1 s", "next": {"x": "0.5*x + u"}}
PLAIN = {"version": 1, "name": "plain", "model": MODEL}
CERTIFIED = {
    **PLAIN,
    "backend": {**MODEL, "next": {"x": "0.5*x + u + abs(x)/64"}},
    "domain": {"x": [-1, 1], "u": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 20, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "certificate": {"claim": "empirical", "violation": 0.05, "confidence": 0.9},
    "report": {"html": False, "rerun": False},
}


@pytest.fixture
def with_components(monkeypatch):
    def put(*more):
        known = installed()
        made = Registry([*known.components.values(), *more], known.broken, known.manager)
        for place in ("gapcert.contracts.plugins.registry.installed", "gapcert.cli.main.installed"):
            monkeypatch.setattr(place, lambda: made)

    return put


@pytest.mark.run
def test_a_study_of_five_lines_is_carried_out(with_components, tmp_path):
    with_components(*knocking.components())
    spec = {**PLAIN, "knock": {"times": 3}, "report": {"html": False, "rerun": False}, "expect": {"verdict": "knocked"}}
    done = gc.run(spec, out=tmp_path)
    assert (done.summary["reason"], done.artifacts["knocks"], done.exit_code) == ("3 times on wood", 3, 0)
    assert json.loads((done.folder / "summary.json").read_text())["verdict"] == "knocked"
    assert RunFolder.at(done.folder).kind == "knock"
    with_components(Component("study", "knock", "knocks", "no_such:Study", "no_such:Section"))
    assert RunFolder.at(done.folder).kind == "certify"  # its package fails by now, and a list of runs goes on
    with_components(*knocking.components())
    assert schema()["properties"]["knock"]["description"] == "knocks, and what they are on"
    with pytest.raises(gc.SpecError, match=r"knock: 'knock' needs 'model'"):
        gc.load_spec({k: v for k, v in spec.items() if k != "model"})
    with pytest.raises(gc.SpecError, match=r"knock: 'knock' does not go with 'compare'"):
        gc.load_spec({**CERTIFIED, "knock": {"times": 3}, "compare": {"backends": {"a": MODEL}}})
    with pytest.raises(gc.SpecError, match=r"knock\.times: found 'often'"):
        gc.load_spec({**spec, "knock": {"times": "often"}})


@pytest.mark.run
def test_a_section_that_asks_for_nothing_goes_along_with_a_certificate(with_components, tmp_path):
    with_components(*knocking.components())
    done = gc.run({**CERTIFIED, "note": {"text": "a first try"}}, out=tmp_path)
    assert done.summary["verdict"] == "holds"


@pytest.mark.unit
def test_a_command_is_there_with_its_arguments(with_components, capsys):
    with_components(*knocking.components())
    assert main(["hello", "Ada", "--json"]) == 0
    said = capsys.readouterr()
    assert (json.loads(said.out), said.err) == ({"hello": "Ada"}, "hello, Ada\n")
    assert main(["--help"]) == 0
    assert "greet somebody" in capsys.readouterr().out


@pytest.mark.run
def test_a_study_after_a_certificate_adds_to_its_summary(with_components, tmp_path):
    with_components(*knocking.components())
    spec = {**CERTIFIED, "along": {}, "expect": {"along.largest <=": 0.1, "certificate.claim.kind": "empirical"}}
    done = gc.run(spec, out=tmp_path)
    assert done.exit_code == 0
    assert 0 < json.loads((done.folder / "summary.json").read_text())["along"]["largest"] < 0.1
    with pytest.raises(gc.SpecError, match=r"along: 'along' needs 'certificate'"):
        gc.load_spec({**PLAIN, "along": {}})


@pytest.mark.unit
def test_those_of_others_are_listed(with_components, capsys):
    with_components(*knocking.components())
    assert main(["plugins", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    found = {(r["kind"], r["name"]) for r in rows if not r["distribution"] and r["available"]}
    assert found == {("study", "knock"), ("study", "along"), ("section", "note"), ("command", "hello")}
    assert ("study", "diagnose") not in {(r["kind"], r["name"]) for r in rows}


@pytest.mark.unit
def test_commands_that_cannot_be_are_told_and_left_out(with_components, capsys):
    with_components(*knocking.components(), *knocking.wrong())
    assert main(["hello", "Ada"]) == 0
    said = capsys.readouterr()
    assert said.out == "hello, Ada\n"
    told = said.err.splitlines()
    assert told == [
        "warning: acme 1.0 declares command 'nowhere inner', and there is no command 'nowhere'; it is left out",
        "warning: acme 1.0 declares command 'run', which is Gapcert's own; it is left out",
    ]
    assert main(["run", "no-such-spec.yaml"]) == 2


@pytest.mark.contract
def test_sections_that_cannot_be_read_disturb_only_specs_that_have_them(with_components):
    gone, domain, *_ = knocking.wrong()
    with_components(gone)
    assert gc.load_spec(CERTIFIED).task == "certify"
    with pytest.raises(gc.SpecError, match=r"gone: cannot be read \(ModuleNotFoundError: .*a fault of acme 1\.0") as error:
        gc.load_spec({**CERTIFIED, "gone": {"a": 1}})
    assert "internal" not in str(error.value)
    assert schema()["properties"]["gone"]["description"] == "a section that cannot be read"
    with_components(domain)
    with pytest.raises(gc.UsageError, match=r"acme 1\.0 declares section 'domain', which is Gapcert's own"):
        gc.load_spec(CERTIFIED)
