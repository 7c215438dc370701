"""What was asked, saved and counted before modules moved is the same after: against what commit fae8e6d wrote."""

import importlib
import json
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import outsider
import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert.numerics.digest import identity, located

WRITTEN = Path(__file__).parents[1] / "identity"
PACKAGES = ("gapcert", *sorted(p.name for p in (WRITTEN.parents[1] / "plugins").iterdir() if (p / "__init__.py").exists()))
GONE = {
    "gapcert_symbolic.kernels:Threaded": "the threads of Numba are set where kernels are compiled",
    "gapcert_symbolic.abstraction:Axis": "what a step may touch along an axis is gapcert_cells:Along, whether promised or not",
    "gapcert_symbolic.solvers:Compiled": "which solver answers a problem is for the order of SOLVERS to say",
    "gapcert_symbolic.solvers:Fixpoints": "as above",
    "gapcert_equations.build:OutputDelays": "delays of outputs are Delays, as those of inputs are",
    "gapcert_gymnasium.adapters:Own": "an environment of the user's is an Attribute like the known ones",
    "gapcert.diagnosis.asked:Answer": "what a study found is an Outcome, whatever the study",
    "gapcert.events:Stages": "a protocol that only gapcert.run:_Stages had",
    "gapcert.spec.check:_Ranges": "sections that are one value each are read by one model",
    "gapcert.spec.cuts:_": "as above",
    "gapcert.spec.editor:_Commented": "an error that was caught where it was raised",
    "gapcert.testing.hidden.": "the generator of hidden effects is no part of the package any more",
    "gapcert.options:Adjustable": "a protocol of configs, which ConfigContract has among others",
    "gapcert.testing.contact:": "fields that only the suite attacks bounds with are its own",
    "gapcert.testing.faulty:": "engines with planted faults are the suite's own",
    "gapcert.testing.fields:Bump": "as the fields of contact",
    "gapcert.testing.fields:Coarse": "as the fields of contact",
}
"""Classes that nothing saved can hold, or all of a module's, and why there are none."""


@pytest.fixture(scope="module")
def writer():
    sys.path.insert(0, str(WRITTEN))
    yield importlib.import_module("write")
    sys.path.remove(str(WRITTEN))
    del sys.modules["write"]


@pytest.fixture
def written(tmp_path):
    with zipfile.ZipFile(WRITTEN / "written.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


def stored(name):
    with zipfile.ZipFile(WRITTEN / "written.zip") as archive:
        return json.loads(archive.read(name))


def bits(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.unit
def test_third_parties_systems_have_the_digests_of_before(writer):
    assert {name: system.digest() for name, system in writer.systems().items()} == stored("digests.json")["systems"]


@pytest.mark.run
def test_shipped_specs_ask_what_they_asked_before(writer):
    """Where the text of a spec is the same: where it is another, so is the question."""
    was, found = stored("digests.json")["questions"], writer.questions()
    same = [name for name in was if found.get(name, {}).get("spec") == was[name]["spec"]]
    assert {name: found[name] for name in same} == {name: was[name] for name in same}
    assert len(same) > len(was) / 2


@pytest.mark.contract
def test_every_class_is_found_by_the_name_that_it_had():
    names = [f"{module}:{name}" for module, names in stored("classes.json").items() for name in names]
    left = [name for name in names if not name.startswith(tuple(GONE))]
    assert [name for name in left if identity(located(name, PACKAGES)) != name] == []
    assert len(left) > 650


@pytest.mark.contract
def test_a_third_partys_question_is_the_same_audit_of_the_same_samples(writer, written):
    before = bits(written / "outside")
    kept = {path: text for path, text in before.items() if path.name != "ledger.json"}
    # Its γ has another e today and is another function; the audit of before counts for the same question.
    assert [writer.certificate(written / "outside" / "run").audit.k for _ in range(2)] == [2, 2]
    assert kept.items() <= bits(written / "outside").items()
    assert writer.certificate(written / "outside" / "run", seed=1).audit.k == 3


@pytest.mark.exam
@pytest.mark.parametrize("name", ["cells", "predictive"])
def test_a_run_is_gone_on_with_verified_and_its_controller_answers(writer, written, name):
    ledger, samples = (written / name / "ledger.json").read_bytes(), bits(next((written / name).glob(f"{name}-*/samples")))
    run = gc.run(written / f"{name}.yaml", out=written / name)
    assert [run.folder] == list((written / name).glob(f"{name}-*"))
    # Its γ has another e today and is another function; the audit of before counts for the same question, and stands as it was.
    assert run.summary["certificate"]["audit"]["number"] == 2
    book = json.loads((written / name / "ledger.json").read_text())
    assert (book["older"], [kind for _, kind, _, _ in book["lines"]]) == (json.loads(ledger), ["audit", "closed loop"])
    assert samples.items() <= bits(run.folder / "samples").items()
    with zipfile.ZipFile(WRITTEN / "written.zip") as archive:
        shutil.rmtree(run.folder)
        archive.extractall(written)
    assert main(["verify", str(run.folder)]) == 0
    answers = writer.answers(gc.load_controller(run.folder / "controller" / "with_gamma"))
    for key, values in stored(f"{name}/answers.json").items():
        # Cells have the inputs of a grid; a solver's last bits are the machine's.
        assert answers[key] == (values if name == "cells" else pytest.approx(values, rel=1e-9, abs=1e-9)), key


@pytest.fixture
def moved(tmp_path, monkeypatch):
    """A package in which everything has moved."""
    package = tmp_path / "movers"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "here.py").write_text(
        "class Kept:\n    class Inner:\n        pass\nclass Renamed:\n    pass\nclass Fresh:\n    pass\n"
    )
    (package / "identities.json").write_text(
        json.dumps({"movers.here": "movers.was", "movers.here:Renamed": "gapcert.old:Name"})
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("movers.here")
    for name in ("movers", "movers.here"):
        del sys.modules[name]


@pytest.mark.unit
def test_a_package_says_where_its_things_were(moved):
    names = {"movers.was:Kept": moved.Kept, "movers.was:Kept.Inner": moved.Kept.Inner, "gapcert.old:Name": moved.Renamed}
    for name, kind in names.items():
        assert identity(kind) == name
        assert located(name, ("movers",)) is kind
    with pytest.raises(ImportError, match=r"movers\.was"):
        located("movers.was:Kept", ())
    with pytest.raises(AttributeError, match="Never"):
        located("movers.was:Never", ("movers",))
    assert identity(len) == "builtins:len"
    assert identity([].append) == "None:list.append"


@pytest.mark.unit
def test_a_move_that_no_package_tells_of_is_another_question(writer, monkeypatch):
    """Necessity: the digest is of the names."""
    was = stored("digests.json")["systems"]
    monkeypatch.setattr(gc.StateSpec, "__module__", "gapcert.somewhere.states")
    assert not {system.digest() for system in writer.systems().values()} & set(was.values())


@pytest.mark.unit
def test_a_model_that_is_wrapped_counts_by_its_own_digest():
    """What it has cached is no part of the question."""
    model = outsider.model()
    wrapped = outsider.Outsider(0.01, model)
    before = wrapped.digest()
    model.constant_slopes(np.zeros(1))
    assert wrapped.digest() == before
    assert outsider.Outsider(0.01, outsider.model()).digest() == before
    other = {**outsider.LINE, "next": {"x": "0.5*x + 2*u"}}
    config = gc.registry().config("model", "equations").model_validate(other)
    assert outsider.Outsider(0.01, gc.registry().build("model", "equations", config)).digest() != before
