"""Backend `fmu`: FMUs of our own, compiled here, against their equations; purity, memory, archives of strangers, mistakes."""

from __future__ import annotations

import importlib.util
import shutil
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest

if shutil.which("cc") is None:
    pytest.skip("there is no C compiler", allow_module_level=True)

import gapcert as gc
from gapcert import Context, UsageError, registry
from gapcert.testing import SystemContract
from gapcert_fmu.config import FmuConfig

pytestmark = [pytest.mark.needs("fmpy"), pytest.mark.contract]


ROOT = Path(__file__).parents[2]
HERE = ROOT / "specs/models/fmu"
TAU = 0.01
PENDULUM = {"states": {"theta": "theta", "omega": "omega"}, "inputs": {"torque": "torque"}, "period": "10 ms"}
TANK = {"states": {"h": "level", "T": "temperature"}, "inputs": {"q": "inflow", "P": "heat"}, "period": "1 s"}
ROOM = {"states": {"T": "temperature"}, "inputs": {"sun": "sun"}, "period": "20 s"}

MODEL = {
    "kind": "equations",
    "states": {"theta": "rad", "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"J": "1 kg*m^2"},
    "derivative": {"theta": "omega", "omega": "torque/J"},
    "period": "10 ms",
}


def builder():
    spec = importlib.util.spec_from_file_location("fmu_build", HERE / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FOLDER: list[Path] = []


@pytest.fixture(scope="module", autouse=True)
def fmus(tmp_path_factory):
    """What is compiled once for all tests of this file."""
    folder, make = tmp_path_factory.mktemp("fmus"), builder()
    for name, model, fmi, flags in (
        ("pendulum2", "pendulum", 2, ()),
        ("pendulum3", "pendulum", 3, ()),
        ("saves_nothing", "pendulum", 2, ("-DNO_SNAPSHOTS",)),
        ("forgets", "pendulum", 2, ("-DNO_SNAPSHOTS", "-DFORGETS_TO_RESET")),
        ("tank", "tank", 3, ()),
        ("room", "thermostat", 3, ()),
    ):
        make.build(model, folder / f"{name}.fmu", fmi, flags)
    FOLDER[:] = [folder]
    return folder


def backend(name="pendulum3", **options):
    from gapcert_fmu.system import FmuBackend

    return FmuBackend(FmuConfig(file=FOLDER[0] / f"{name}.fmu", **(PENDULUM | options)))


def query(n=12, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (n, 2)), rng.uniform(-1, 1, (n, 1))


def rk4(x, u, tau=TAU, steps=10, d=0.05, m=1.0):
    """Runge–Kutta's classical method with steps of 1 ms, which is what the C code has."""
    h = tau / steps

    def rate(y):
        return np.stack([y[:, 1], -14.715 * np.sin(y[:, 0]) + 3 * (u[:, 0] - d * y[:, 1]) / m], axis=1)

    for _ in range(steps):
        a = rate(x)
        b = rate(x + h / 2 * a)
        c = rate(x + h / 2 * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
    return x


class TestCoSimulation(SystemContract):
    def system(self):
        return backend("pendulum2")


class TestModelExchangeWithHiddenRate(SystemContract):
    rows = 7

    def system(self):
        return backend("pendulum3", states={"theta": "theta"}, interface="model-exchange", substeps=4)


@pytest.mark.exam
class TestWithoutSnapshots(SystemContract):
    rows = 7

    def system(self):
        return backend("saves_nothing")


# The physics


def test_a_communication_step_begins_where_the_last_one_ended(monkeypatch):
    from gapcert_fmu.instance import Instance

    f, own, seen = backend(substeps=4, time=2.0), Instance.advance, []
    monkeypatch.setattr(Instance, "advance", lambda self, time, step: (seen.append((time, step)), own(self, time, step))[1])
    f.step(*query(1))
    assert seen == [(pytest.approx(2.0 + k * TAU / 4), pytest.approx(TAU / 4)) for k in range(4)]


@pytest.mark.parametrize("name", ["pendulum2", "pendulum3"])
@pytest.mark.parametrize(("interface", "substeps"), [("co-simulation", 1), ("co-simulation", 5), ("model-exchange", 10)])
def test_both_versions_and_interfaces_step_the_equations(name, interface, substeps):
    x, u = query()
    found = backend(name, interface=interface, substeps=substeps).step(x, u).x
    assert np.abs(found - rk4(x, u)).max() <= 1e-14


def test_euler_is_euler():
    x, u = query()
    found = backend(interface="model-exchange", integrator="euler").step(x, u).x
    rate = np.stack([x[:, 1], -14.715 * np.sin(x[:, 0]) + 3 * (u[:, 0] - 0.05 * x[:, 1])], axis=1)
    assert np.abs(found - x - TAU * rate).max() <= 1e-15


def test_parameters_are_the_fmus_own_with_units_and_bounds():
    b = backend()
    stated = {p.name: (p.value, p.unit, p.low) for p in b.parameters}
    assert stated == {
        "m": (1.0, "kg", 0.0),
        "l": (1.0, "m", 0.0),
        "g": (9.81, "m/s**2", 0.0),
        "d": (0.05, "N*m*s/rad", 0.0),
    }
    x, u = query()
    assert np.abs(b.step(x, u, parameters={"d": 0.3}).x - rk4(x, u, d=0.3)).max() <= 1e-14
    assert np.abs(backend(set={"d": 0.3}).step(x, u).x - rk4(x, u, d=0.3)).max() <= 1e-14
    with pytest.raises(UsageError, match=r"parameter d = -1.0; expected a number in \[0.0, inf\]"):
        b.step(x, u, parameters={"d": -1.0})


def test_a_tank_keeps_its_balances():
    from gapcert_fmu.system import FmuBackend

    b = FmuBackend(FmuConfig(file=FOLDER[0] / "tank.fmu", **(TANK | {"period": "60 s"})))
    x, u = np.array([[0.5, 320.0]]), np.array([[1e-3, 2000.0]])
    after = b.rollout(x, np.repeat(u[:, None], 80, axis=1)).x[0, -1]
    level = (1e-3 / 3e-4) ** 2 / (2 * 9.81)
    warm = (1e-3 * 4.18e6 * 290 + 2000 + 40 * 293) / (1e-3 * 4.18e6 + 40)
    assert after == pytest.approx([level, warm], rel=1e-6)


def test_events_are_located_and_what_they_change_is_hidden_state():
    """A thermostat switches between two communication points, and the room goes on from there."""
    from gapcert_fmu.system import FmuBackend

    room = {"file": FOLDER[0] / "room.fmu", **ROOM}
    fine = FmuBackend(FmuConfig(**room, interface="model-exchange", substeps=4))
    assert [h.name for h in fine.hidden] == ["on"]
    x, u = np.array([[293.95], [293.95], [292.05]]), np.zeros((3, 1))
    on = np.array([[1.0], [0.0], [0.0]])
    out = fine.step(x, u, hidden=on)
    power, loss, c = 2000.0, 50.0, 2e5

    def relaxed(start, target, seconds):
        return target + (start - target) * np.exp(-loss / c * seconds)

    hot, cold = 273 + power / loss, 273.0
    switched = -c / loss * np.log((hot - 294.0) / (hot - 293.95))
    assert out.x[0, 0] == pytest.approx(relaxed(294.0, cold, 20 - switched), abs=1e-8)
    assert out.x[1, 0] == pytest.approx(relaxed(293.95, cold, 20), abs=1e-9)
    back = -c / loss * np.log((292.0 - cold) / (292.05 - cold))
    assert out.x[2, 0] == pytest.approx(relaxed(292.0, hot, 20 - back), abs=1e-8)
    assert out.hidden[:, 0].tolist() == [0.0, 0.0, 1.0]
    coarse = FmuBackend(FmuConfig(**room)).step(x, u, hidden=on)
    assert np.abs(coarse.x - out.x).max() < 2e-5
    assert coarse.hidden.tobytes() == out.hidden.tobytes()


# A function of its states


def test_the_quickest_restart_that_is_right_is_taken():
    assert backend().restarting == "snapshot, bit-equal to a new instance"
    assert backend("saves_nothing").restarting == "the FMU saves no snapshots; reset, bit-equal to a new instance"
    forgetful = backend("forgets")
    assert forgetful.restarting.endswith("after a reset it answers otherwise than when new; a new instance per query")
    x, u = query(5)
    assert forgetful.step(x, u).x.tobytes() == backend().step(x, u).x.tobytes()
    asked = backend("forgets", restart="reset")
    assert asked.restarting == "reset, as asked for"
    asked.step(x, u, parameters={"d": 0.3})
    assert asked.step(x, u).x.tobytes() != forgetful.step(x, u).x.tobytes(), "what auto saves the user from"


@pytest.mark.parametrize("interface", ["co-simulation", "model-exchange"])
def test_an_fmu_that_remembers_more_is_refused(tmp_path, interface):
    """The same library under a description that keeps a state to itself, as many exporters do."""
    from gapcert_fmu.system import FmuBackend

    with zipfile.ZipFile(FOLDER[0] / "pendulum3.fmu") as old, zipfile.ZipFile(tmp_path / "shy.fmu", "w") as new:
        for entry in old.infolist():
            text = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = text.replace(
                    b"name='omega' valueReference='1' causality='output' variability='continuous' initial='exact'",
                    b"name='omega' valueReference='1' causality='output' variability='continuous' initial='calculated'",
                )
                text = text.replace(b" unit=\"rad/s\" start='0.0'", b"").replace(
                    b"<ContinuousStateDerivative valueReference='3'/>", b""
                )
                text = text.replace(
                    b"valueReference='3' causality='local' variability='continuous' derivative='1'",
                    b"valueReference='3' causality='local' variability='continuous'",
                )
                text = text.replace(
                    b"<InitialUnknown valueReference='3'/>",
                    b"<InitialUnknown valueReference='1'/><InitialUnknown valueReference='3'/>",
                )
            new.writestr(entry, text)
    options = {"file": tmp_path / "shy.fmu", "states": {"theta": "theta"}, "inputs": {"torque": "torque"}, "period": "10 ms"}
    if interface == "model-exchange":
        with pytest.raises(UsageError, match=r"status 3|remembers more"):
            FmuBackend(FmuConfig(**options, interface=interface))
        return
    with pytest.raises(UsageError, match=r"remembers more than its states.*memory: forget"):
        FmuBackend(FmuConfig(**options, interface=interface))
    forgetting = FmuBackend(FmuConfig(**options, memory="forget"))
    assert not forgetting.hidden
    assert forgetting.step(np.array([[0.1]]), np.zeros((1, 1))).x.shape == (1, 1)


def test_a_tolerance_is_the_resolution():
    assert (backend().resolution(np.ones(2)) < 1e-14).all()
    b = backend(tolerance=1e-6)
    assert (b.resolution(np.ones(2)) == 1e-6).all()
    assert (b.rounding(np.ones(2)) < 1e-14).all()


# Code of a stranger


def test_a_spec_does_not_run_it_by_itself():
    from gapcert_fmu.system import FmuBackend

    config = FmuConfig(file=FOLDER[0] / "pendulum3.fmu", **PENDULUM)
    with pytest.raises(UsageError, match="--allow-code"):
        registry().build("backend", "fmu", config, Context())
    with pytest.raises(UsageError, match="holds native code"):
        FmuBackend.from_config(config, Context())
    assert registry().build("backend", "fmu", config, Context(allow_code=True)).nx == 2


def link(name="resources/link"):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


@pytest.mark.parametrize(
    ("entry", "content", "message"),
    [
        ("../outside", b"x", "points out of the archive"),
        ("resources/../../outside", b"x", "points out of the archive"),
        ("/etc/outside", b"x", "points out of the archive"),
        ("..\\outside", b"x", "points out of the archive"),
        ("C:/outside", b"x", "points out of the archive"),
        (link(), b"/etc/passwd", "no plain file"),
        ("resources/zeros", b"\0" * (3 << 20), "unpacks to more than 2 MB"),
        ("modelDescription.xml", b"<x/>", "is there twice"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_hostile_archives_are_refused(tmp_path, entry, content, message):
    from gapcert_fmu.system import FmuBackend

    path = tmp_path / "inner" / "bad.fmu"
    path.parent.mkdir()
    shutil.copy(FOLDER[0] / "pendulum3.fmu", path)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(entry, content)
    with pytest.raises(UsageError, match=message):
        FmuBackend(FmuConfig(file=path, megabytes=2, **PENDULUM))
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["bad.fmu", "inner"]


def test_sizes_are_counted_and_not_believed(tmp_path):
    """An archive that says of 3 MB that they are 10 bytes."""
    from gapcert_fmu.system import FmuBackend

    path = tmp_path / "liar.fmu"
    with zipfile.ZipFile(FOLDER[0] / "pendulum3.fmu") as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for e in old.infolist():
            new.writestr(e, old.read(e))
        new.writestr("resources/zeros", b"\0" * (3 << 20))
        new.filelist[-1].file_size = 10
    with pytest.raises(UsageError, match=r"cannot be unpacked|unpacks to more"):
        FmuBackend(FmuConfig(file=path, megabytes=2, **PENDULUM))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[: len(d) // 2], "cannot be unpacked"),
        (lambda d: b"", "cannot be unpacked"),
        (lambda d: b"not a zip", "cannot be unpacked"),
    ],
)
def test_broken_files_are_told(tmp_path, change, message):
    from gapcert_fmu.system import FmuBackend

    path = tmp_path / "broken.fmu"
    path.write_bytes(change((FOLDER[0] / "pendulum3.fmu").read_bytes()))
    with pytest.raises(UsageError, match=message):
        FmuBackend(FmuConfig(file=path, **PENDULUM))


@pytest.mark.parametrize(
    ("replace", "message"),
    [
        ({"binaries/": "binaries/win64/"}, "no binary for this machine.*it has those for win64"),
        ({"modelDescription.xml": "description.xml"}, "has no modelDescription.xml"),
        ({b"<fmiModelDescription": b"<!DOCTYPE x [<!ENTITY a 'b'>]><fmiModelDescription"}, "without a DOCTYPE"),
        ({b"fmiVersion='3.0'": b"fmiVersion='1.0'"}, "not valid|FMI 1.0"),
        ({b"causality='input'": b"causality='thing'"}, "not valid"),
        ({b"<CoSimulation": b"<CoSimulation needsExecutionTool='true'"}, "needs the tool"),
    ],
)
def test_fmus_that_cannot_run_are_told(tmp_path, replace, message):
    from gapcert_fmu.system import FmuBackend

    path = tmp_path / "other.fmu"
    with zipfile.ZipFile(FOLDER[0] / "pendulum3.fmu") as old, zipfile.ZipFile(path, "w") as new:
        for e in old.infolist():
            name, text = e.filename, old.read(e)
            for a, b in replace.items():
                if isinstance(a, str):
                    name = f"{b}{Path(name).name}" if a.endswith("/") and name.startswith(a) else b if name == a else name
                elif name == "modelDescription.xml":
                    text = text.replace(a, b)
            new.writestr(name, text)
    with pytest.raises(UsageError, match=f"(?s){message}"):
        FmuBackend(FmuConfig(file=path, **PENDULUM))


# Mistakes


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"states": {"theta": "thetta", "omega": "omega"}}, "no variable 'thetta'; did you mean 'theta'"),
        ({"states": {"theta": "energy", "omega": "omega"}}, "cannot be given a start value.*start: PARAMETER"),
        ({"inputs": {"torque": "d"}}, "of causality parameter; expected an input"),
        ({"set": {"dd": 1.0}}, "no variable 'dd'"),
        ({"set": {"d": -1.0}}, "as the FMU says"),
    ],
)
def test_mistakes_are_told(options, message):
    with pytest.raises(UsageError, match=message):
        backend(**options)


def test_units_are_checked_against_the_model():
    from gapcert_fmu.system import FmuBackend

    model = gc.load_spec({"version": 1, "name": "x", "model": MODEL}).build("model")
    config = FmuConfig(file=FOLDER[0] / "pendulum3.fmu", **(PENDULUM | {"period": None}))
    assert FmuBackend(config, model=model).period == TAU
    swapped = config.model_copy(update={"states": {"theta": "omega", "omega": "theta"}})
    with pytest.raises(UsageError, match=r"states\.theta: the model gives it in rad, but 'omega' of the FMU is in rad/s"):
        FmuBackend(swapped, model=model)
    short = config.model_copy(update={"states": {"theta": "theta"}})
    with pytest.raises(UsageError, match="'omega' of the model is missing"):
        FmuBackend(short, model=model)


def test_units_of_modelica_are_read():
    from gapcert_fmu.description import spelled

    assert [spelled(u) for u in ("N.m", "m/s2", "kg.m2", "rad/s", "degC", "W/(m2.K)")] == [
        "N*m", "m/s**2", "kg*m**2", "rad/s", "degC", "W/(m**2*K)"]  # fmt: skip


def test_a_file_that_changed_is_not_taken_for_the_old_one(tmp_path):
    import pickle

    from gapcert_fmu.system import FmuBackend

    path = tmp_path / "p.fmu"
    shutil.copy(FOLDER[0] / "pendulum3.fmu", path)
    b = FmuBackend(FmuConfig(file=path, **PENDULUM))
    kept = pickle.dumps(b)
    shutil.copy(FOLDER[0] / "pendulum2.fmu", path)
    with pytest.raises(UsageError, match="has changed since it was read"):
        pickle.loads(kept)


def test_missing_package_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(gc.MissingDependency, match=r"needs fmpy.*pip install 'gapcert\[fmu\]'"):
        registry().build("backend", "fmu", FmuConfig(file=Path("x.fmu"), **PENDULUM), Context(allow_code=True))


@pytest.mark.exam
def test_example_runs(tmp_path):
    spec = gc.load_spec(
        ROOT / "specs/tank_fmu.yaml", (f"backend.file={FOLDER[0] / 'tank.fmu'}", "report.html=false", "report.rerun=false")
    )
    summary = gc.run(spec, out=tmp_path, allow_code=True).summary
    assert all(e["met"] for e in summary["expectations"]), summary["expectations"]
