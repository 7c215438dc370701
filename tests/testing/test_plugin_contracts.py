"""The contracts of models, readers, executors, observers and declarations: ours keep them, and each check catches its fault."""

from __future__ import annotations

import concurrent.futures
import csv
import itertools
from functools import partial

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import processes, threads
from gapcert.contracts.systems.system import Model
from gapcert.testing import ExecutorContract, ModelContract, ObserverContract, PluginContract, ReaderContract, write_csv
from gapcert.testing.observers import SPEC
from gapcert.testing.toys import Drift
from gapcert_diagnosis.testing import PAIR, PLAIN, equations


def checks(contract):
    return {name for name in dir(contract) if name.startswith("test_")}


# --- models


class Sway(Model):
    """x⁺ = x + τ sin x + τ u, as a white box with everything that a model may know."""

    def __init__(self, period=0.1):
        self.states, self.inputs, self.period = (gc.StateSpec("x", "rad", "angle"),), (gc.StateSpec("u", "rad/s"),), period
        self.outputs = self.states

    def _step(self, x, u, **options):
        return x + self.period * (np.sin(x) + u)

    def jacobian(self, x, u):
        return np.stack([1 + self.period * np.cos(x), np.full_like(u, self.period)], axis=-1)

    def enclosure(self, z):
        return z[:, :1] + (z[:, :1].sin() + z[:, 1:]) * self.period

    def jacobian_enclosure(self, z):
        return gc.Interval.stack([z[:, :1].cos() * self.period + 1.0, np.full((len(z), 1), self.period)], axis=2)

    def curvature_enclosure(self, z, axis):
        return z[:, :1].sin() * -self.period if axis == 0 else gc.Interval.exact(np.zeros((len(z), 1)))

    def extend(self, extensions):
        raise gc.UsageError("Sway: it has no sites; use an equations model")

    def equations(self):
        return "x⁺ = x + τ (sin x + u)"

    def to_spec(self):
        return {
            "kind": "equations",
            "states": {"x": {"unit": "rad", "kind": "angle"}},
            "inputs": {"u": "rad/s"},
            "parameters": {"tau": f"{self.period} s", "k": "1 rad/s"},
            "next": {"x": "x + tau*(k*sin(x) + u)"},
            "period": f"{self.period} s",
        }

    def sites(self, kind):
        return ()


MODEL_FAULTS = {
    "test_outputs_have_columns": {"output": lambda self, x, u, parameters=None: x[:, 0]},
    "test_jacobian_is_the_slope": {"jacobian": lambda self, x, u: Sway.jacobian(self, x, u) * 1.001},
    "test_enclosure_holds": {"enclosure": lambda self, z: Sway.enclosure(self, gc.Interval.exact(z.mid))},
    "test_enclosure_closes_in": {"enclosure": lambda self, z: Sway.enclosure(self, z) + gc.Interval.around(0.0, 1e-6)},
    "test_jacobian_enclosure_holds": {"jacobian_enclosure": lambda self, z: Sway.jacobian_enclosure(self, z) * 0.99},
    "test_slopes_hold_between_points": {
        "jacobian": lambda self, x, u: Sway.jacobian(self, x, u) * 0.9,
        "jacobian_enclosure": lambda self, z: Sway.jacobian_enclosure(self, z) * 0.9,
    },
    "test_curvature_holds": {"curvature_enclosure": lambda self, z, axis: Sway.curvature_enclosure(self, z, axis) * 0.5},
    "test_what_is_said_not_to_move_stays": {"unmoved": lambda self, u: np.ones((len(u), 1), dtype=bool)},
    "test_fast_rollout_is_a_rollout": {
        "fast_rollout": lambda self, x0, u, **options: gc.plugin.Step(Sway.fast_rollout(self, x0, u, **options).x * (1 + 1e-6))
    },
    "test_unknown_sites_are_refused": {"extend": lambda self, extensions: self},
    "test_equations_are_text": {"equations": lambda self: "see the paper"},
    "test_spec_builds_it_again": {"to_spec": lambda self: Sway(0.2).to_spec()},
}


def test_every_check_of_models_has_a_planted_fault():
    from gapcert.testing import SystemContract

    assert set(MODEL_FAULTS) == checks(ModelContract) - checks(SystemContract)


@pytest.mark.exam
@pytest.mark.parametrize("section", [PAIR, PLAIN], ids=["mechanical", "plain"])
@pytest.mark.parametrize("check", sorted(set(MODEL_FAULTS) - {"test_fast_rollout_is_a_rollout"}))
def test_our_models_pass(section, check):
    """Their compiled rollouts are compared in the tests of the plugin, and what every System keeps, too."""

    class Ours(ModelContract):
        def system(self):
            return equations(section)

    getattr(Ours(), check)()


@pytest.mark.parametrize("check", MODEL_FAULTS)
def test_an_honest_model_passes(check):
    class Honest(ModelContract):
        def system(self):
            return Sway()

    getattr(Honest(), check)()


@pytest.mark.parametrize("check", MODEL_FAULTS)
def test_a_faulty_model_is_caught(check):
    class Faulty(ModelContract):
        def system(self):
            return type("Faulty", (Sway,), MODEL_FAULTS[check])()

    with pytest.raises(AssertionError):
        getattr(Faulty(), check)()


def test_a_model_whose_own_spec_is_refused_is_caught():
    class Bare(ModelContract):
        def system(self):
            unitless = {"next": {"x": f"x + {Sway().period!r}*(sin(x) + u)"}, "parameters": {}}
            return type("Bare", (Sway,), {"to_spec": lambda self: Sway.to_spec(self) | unitless})()

    with pytest.raises(AssertionError, match=r"what to_spec says is refused: .*model\.next\.x: "):
        Bare().test_spec_builds_it_again()


def test_a_drift_is_built_again_from_its_own_spec():
    drift = Drift(2)
    spec = gc.load_spec({"version": 1, "name": "drift", "model": drift.to_spec()})
    again, rng = spec.build("model"), np.random.default_rng(3)
    x, u = rng.uniform(-1, 1, (2, 9, 2))
    assert (again.step(x, u).x == drift.step(x, u).x).all()
    assert [(p.name, p.value, p.unit) for p in again.parameters] == [("tau", drift.period, "s")]


# --- readers


def csv_reader(recording, folder, **options):
    config = gc.registry().config("reader", "csv")
    several = {"trajectory": "trajectory"} if len(recording.trajectories) > 1 else {}
    given = {"kind": "csv", "files": ["log.csv"], "columns": {n: n for n in recording.names}, **several, **options}
    return gc.registry().build("reader", "csv", config.model_validate(given), gc.Context(folder))


class TestCsv(ReaderContract):
    def write(self, recording, folder):
        write_csv(recording, folder / "log.csv", digits=12)
        return csv_reader(recording, folder)


class TestParquet(ReaderContract):
    several = False

    def write(self, recording, folder):
        from pyarrow import parquet, table

        (tr,) = recording.trajectories
        parquet.write_table(table({"t": tr.t, **tr.channels}), folder / "log.parquet")
        config = gc.registry().config("reader", "parquet")
        given = {"kind": "parquet", "files": ["log.parquet"], "columns": {n: n for n in recording.names}}
        return gc.registry().build("reader", "parquet", config.model_validate(given), gc.Context(folder))


class TestHdf5(ReaderContract):
    several = False

    def write(self, recording, folder):
        import h5py

        (tr,) = recording.trajectories
        with h5py.File(folder / "log.h5", "w") as file:
            for name, values in {"t": tr.t, **tr.channels}.items():
                file[name] = values
        config = gc.registry().config("reader", "hdf5")
        given = {"kind": "hdf5", "files": ["log.h5"], "columns": {n: n for n in recording.names}}
        return gc.registry().build("reader", "hdf5", config.model_validate(given), gc.Context(folder))


class Plain(gc.plugin.Reader):
    """A small honest reader, for the faults."""

    suffixes = (".csv",)

    def __init__(self, path):
        self.path = path

    @classmethod
    def tables(cls, path):
        with path.open(newline="") as file:
            head, *rows = list(csv.reader(file))
        columns = np.array(rows, dtype=float).T
        return [(path.name, dict(zip(head, columns, strict=True)))]

    def read(self):
        try:
            ((_, table),) = self.tables(self.path)
            label = table.pop("trajectory", np.zeros(len(table["t"])))
            t = table.pop("t")
        except (OSError, ValueError, KeyError) as error:
            raise gc.UsageError(f"recording: {self.path.name}: {error}; expected columns") from None
        cuts = [0, *(np.flatnonzero(np.diff(label)) + 1), len(t)]
        parts = [gc.Trajectory(t[a:b], {k: v[a:b] for k, v in table.items()}) for a, b in itertools.pairwise(cuts)]
        return gc.Recording(tuple(parts))


def plain(made, recording, folder):
    path = folder / "log.csv"
    several = len(recording.trajectories) > 1
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["t", *recording.names, *(["trajectory"] if several else [])])
        for k, tr in enumerate(recording.trajectories):
            label = [np.full(len(tr), k)] if several else []
            out.writerows(np.column_stack([tr.t, *(tr.channels[n] for n in recording.names), *label]).tolist())
    return made(path)


class TestPlainReader(ReaderContract):
    def write(self, recording, folder):
        return plain(Plain, recording, folder)


def faulty_reader(**methods):
    return type("Faulty", (Plain,), methods)


def turned(recording, change):
    whole = [gc.Trajectory(tr.t, {k: change(v) for k, v in tr.channels.items()}) for tr in recording.trajectories]
    return gc.Recording(tuple(whole))


def rescaled(self):
    return turned(Plain.read(self), lambda v: v * 1.001)


def filled(self):
    return turned(Plain.read(self), np.nan_to_num)


COUNT = itertools.count()


def drifting(self):
    r = Plain.read(self)
    return gc.Recording(tuple(gc.Trajectory(tr.t + next(COUNT), tr.channels) for tr in r.trajectories))


def caching(self):
    self.path.with_suffix(".cache").write_text("seen")
    return Plain.read(self)


def nameless(self):
    try:
        return Plain.read(self)
    except gc.UsageError:
        raise gc.UsageError("cannot read the recording") from None


def forgiving(self):
    try:
        return Plain.read(self)
    except gc.UsageError:
        return gc.Recording.of(np.arange(20.0), {"angle": np.zeros(20), "torque": np.zeros(20)})


def made_up(self):
    """Whatever was lost, 40 samples there are."""
    lines = [line.split(",") for line in self.path.read_text().splitlines()[1:-1]]
    t = np.array([float(line[0]) for line in lines])
    t = np.append(t, t[-1] + 0.02 * np.arange(1, 41 - len(t)))
    return gc.Recording.of(t, {"angle": np.sin(t), "torque": np.cos(t)})


READER_FAULTS = {
    "test_numbers_come_back": {"read": rescaled},
    "test_trajectories_come_back_in_order": {"read": lambda self: gc.Recording(Plain.read(self).trajectories[::-1])},
    "test_what_is_missing_stays_missing": {"read": filled},
    "test_reading_again_gives_the_same": {"read": drifting},
    "test_files_are_not_changed": {"read": caching},
    "test_an_absent_file_is_a_sentence": {"read": nameless},
    "test_another_format_is_a_sentence": {"read": forgiving},
    "test_a_cut_file_is_a_sentence_or_shorter": {"read": made_up},
    "test_tables_show_what_is_there": {"tables": classmethod(lambda cls, path: [])},
    "test_suffixes_are_suffixes": {"suffixes": ("csv",)},
}


def test_every_check_of_readers_has_a_planted_fault():
    assert set(READER_FAULTS) == checks(ReaderContract)


@pytest.mark.parametrize("check", READER_FAULTS)
def test_a_faulty_reader_is_caught(check):
    class Faulty(ReaderContract):
        def write(self, recording, folder):
            return plain(faulty_reader(**READER_FAULTS[check]), recording, folder)

    with pytest.raises(AssertionError):
        getattr(Faulty(), check)()


# --- executors


class TestThreads(ExecutorContract):
    def executor(self, workers):
        return threads(workers)


@pytest.mark.exam
class TestProcesses(ExecutorContract):
    def executor(self, workers):
        return processes(workers)


class Wrong(concurrent.futures.ThreadPoolExecutor):
    """Threads whose results go through `spoil`."""

    def submit(self, fn, /, *args, **kwargs):
        return super().submit(partial(self.spoil, fn), *args, **kwargs)

    def spoil(self, fn, *args, **kwargs):
        return fn(*args, **kwargs)


def wrong(**parts):
    return type("Faulty", (Wrong,), parts)


def single(self, fn, *args, **kwargs):
    found = fn(*args, **kwargs)
    return found.astype(np.float32).astype(float) if isinstance(found, np.ndarray) else found


def named_lost(self, fn, *args, **kwargs):
    return fn(*args) if not kwargs else None


def worded(self, fn, *args, **kwargs):
    try:
        return fn(*args, **kwargs)
    except ValueError as error:
        raise RuntimeError(f"remote: {error}") from None


def swapped(self, fn, /, *args, **kwargs):
    self.first = getattr(self, "first", None) or concurrent.futures.ThreadPoolExecutor.submit(self, fn, *args, **kwargs)
    return self.first


def immortal(self, wait=True, *, cancel_futures=False):
    """Goes on taking tasks."""


class Handle:
    def __init__(self, workers):
        self.inner = concurrent.futures.ThreadPoolExecutor(workers)

    def submit(self, fn, /, *args, **kwargs):
        return self.inner.submit(fn, *args, **kwargs)

    def shutdown(self, wait=True):
        self.inner.shutdown(wait)


def elsewhere(self, fn, *args, **kwargs):
    """A worker that has a disk of its own, and does not say so."""
    found = fn(*args, **kwargs)
    if (target := getattr(args[0] if args else None, "target", None)) is not None:
        target.unlink()
    return found


EXECUTOR_FAULTS = {
    "test_is_an_executor": Handle,
    "test_says_how_many_work": wrong(workers="many"),
    "test_answers_are_those_of_this_process": wrong(spoil=single),
    "test_takes_named_arguments": wrong(spoil=named_lost),
    "test_errors_come_back_as_they_were": wrong(spoil=worded),
    "test_more_tasks_than_workers": wrong(submit=swapped),
    "test_ends_when_told": wrong(shutdown=immortal),
    "test_samples_do_not_depend_on_workers": wrong(spoil=elsewhere),
}


def test_every_check_of_executors_has_a_planted_fault():
    assert set(EXECUTOR_FAULTS) == checks(ExecutorContract)


@pytest.mark.parametrize("check", EXECUTOR_FAULTS)
def test_a_faulty_executor_is_caught(check):
    class Faulty(ExecutorContract):
        patience = 0.5

        def executor(self, workers):
            return EXECUTOR_FAULTS[check](workers)

    with pytest.raises((AssertionError, gc.UsageError)):
        getattr(Faulty(), check)()


# --- observers


def rerun_event(event):
    from gapcert_rerun.plugin import gapcert_event

    gapcert_event(event)


@pytest.mark.exam
class TestRerun(ObserverContract):
    """It records."""

    spec = SPEC | {"report": {"html": False, "rerun": True}}

    def observer(self):
        return rerun_event


class Diary:
    """A small honest observer, for the faults: a line per stage, in the folder of the run."""

    def __init__(self):
        self.folder = None

    def __call__(self, event):
        if event.name == "run-started":
            self.folder = event.data["folder"]
        elif event.name == "stage-finished" and self.folder is not None:
            with (self.folder / "diary").open("a") as file:
                print(self.line(event), file=file)
        elif event.name == "run-finished":
            self.folder = None

    def line(self, event):
        return event.stage


class Watched(ObserverContract):
    made = Diary

    def observer(self):
        return self.made()

    def seen(self, folder):
        return (folder / "diary").read_text()


@pytest.mark.exam
class TestDiary(Watched):
    pass


def hears_progress(self, event):
    assert event.name != "progress"


def meddles(self, event):
    if (certificate := event.data.get("certificate")) is not None:
        for array in certificate.gap.arrays().values():
            array *= 1.5


def prints(self, event):
    print(event.name)


def opens_twice(self, event):
    if event.name == "run-started":
        assert self.folder is None
    Diary.__call__(self, event)


def expects_a_start(self, event):
    if event.name == "stage-finished":
        assert self.folder is not None
    Diary.__call__(self, event)


def knows_all(self, event):
    ("run-started", "stage-started", "progress", "stage-finished", "warning", "run-finished").index(event.name)


OBSERVER_FAULTS = {
    "test_watches_a_run": {"__call__": hears_progress},
    "test_changes_nothing": {"__call__": meddles},
    "test_leaves_standard_output_alone": {"__call__": prints},
    "test_tells_of_every_stage": {"line": lambda self, event: "something"},
    "test_survives_a_run_that_never_ends": {"__call__": opens_twice},
    "test_survives_a_start_in_the_middle": {"__call__": expects_a_start},
    "test_survives_what_it_does_not_know": {"__call__": knows_all},
}


def test_every_check_of_observers_has_a_planted_fault():
    assert set(OBSERVER_FAULTS) == checks(ObserverContract)


@pytest.mark.parametrize("check", OBSERVER_FAULTS)
def test_a_faulty_observer_is_caught(check):
    class Faulty(Watched):
        made = type("Faulty", (Diary,), OBSERVER_FAULTS[check])

    with pytest.raises(AssertionError):
        getattr(Faulty(), check)()


# --- declarations


class TestBounds(PluginContract):
    plugin = "gapcert_bounds.plugin"


class TestDiagnosis(PluginContract):
    """A study, a section, commands."""

    plugin = "gapcert_diagnosis.plugin"


HONEST = """
import gapcert
@gapcert.hookimpl
def gapcert_components():
    return [gapcert.Component("backend", "planted", "a toy", "{name}_parts:Toy", "{name}_parts:Options")]
"""
PARTS = """
from typing import Literal
import gapcert
from pydantic import BaseModel, ConfigDict
class Toy(gapcert.Backend):
    provenance = "estimated"
    def _step(self, x, u):
        return x
class Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["planted"]
"""
FAULTS = {
    "test_is_installed": ("", "", ""),
    "test_can_be_used": ("plugin", '"a toy",', '"a toy", requires=("no_such_engine",), target='),
    "test_declaring_imports_nothing_heavy": ("plugin", "import gapcert", "import gapcert, scipy"),
    "test_says_what_it_is": ("plugin", "a toy", " "),
    "test_claims_no_more_than_it_can": ("plugin", '"backend"', '"lipschitz"'),
    "test_targets_are_there": ("parts", "def _step", "def _stop"),
    "test_options_name_their_kind": ("parts", '["planted"]', '["plated"]'),
    "test_unknown_options_are_refused": ("parts", 'extra="forbid", ', ""),
    "test_options_are_frozen": ("parts", ", frozen=True", ""),
    "test_readers_tell_what_their_options_mean": ("parts", '["planted"]', '["planted"]\n    every: float = 1.0'),
}
HONEST_READER = HONEST.replace('"backend"', '"reader"')
"""What the last of them asks are readers alone."""


STUDY = (
    HONEST.replace('"backend"', '"study"').replace('"a toy"', '"a study"'),
    """
from gapcert.plugin import Outcome, Section, SpecSection, Study
class Toy(Study):
    def run(self, build, folder, stages, made):
        return Outcome({})
class Asked(Section):
    times: int = 1
class Options(SpecSection):
    model = Asked
    about = "how often"
""",
)
STUDY_FAULTS = {
    "test_unknown_options_are_refused": ("parts", "times: int = 1", "model_config = {'extra': 'ignore'}"),
    "test_options_are_frozen": ("parts", "times: int = 1", "model_config = {'frozen': False}"),
}


def declared(monkeypatch, tmp_path, name, file="", old="", new="", honest=(HONEST, PARTS)):
    """A plugin on the path with one text replaced, and a contract that finds it installed."""
    import importlib.metadata

    from gapcert.contracts.plugins.registry import discover

    texts = {"plugin": honest[0].replace("{name}", name), "parts": honest[1]}
    if file:
        assert old in texts[file]
        texts[file] = texts[file].replace(old, new)
    if "target=" in texts["plugin"]:
        texts["plugin"] = texts["plugin"].replace(f'"{name}_parts:Options"', f'config="{name}_parts:Options"')
    (tmp_path / f"{name}.py").write_text(texts["plugin"])
    (tmp_path / f"{name}_parts.py").write_text(texts["parts"])
    monkeypatch.syspath_prepend(str(tmp_path))
    point = importlib.metadata.EntryPoint("planted", name, "gapcert")

    class Checks(PluginContract):
        plugin = name

        def _registry(self):
            return discover([point] if file or name.startswith("honest") else [])

    return Checks()


def test_every_check_of_declarations_has_a_planted_fault():
    assert set(FAULTS) == checks(PluginContract)


@pytest.mark.contract
@pytest.mark.parametrize("check", FAULTS)
def test_an_honest_declaration_passes(check, monkeypatch, tmp_path):
    getattr(declared(monkeypatch, tmp_path, "honest"), check)()


@pytest.mark.contract
@pytest.mark.parametrize("check", FAULTS)
def test_a_faulty_declaration_is_caught(check, monkeypatch, tmp_path):
    honest = (HONEST_READER if "readers" in check else HONEST, PARTS)
    contract = declared(monkeypatch, tmp_path, f"planted_{list(FAULTS).index(check)}", *FAULTS[check], honest=honest)
    with pytest.raises(AssertionError):
        getattr(contract, check)()


@pytest.mark.contract
@pytest.mark.parametrize("check", STUDY_FAULTS)
def test_the_options_of_a_study_are_those_of_its_section(check, monkeypatch, tmp_path):
    getattr(declared(monkeypatch, tmp_path, "honest_study", honest=STUDY), check)()
    name = f"planted_study_{list(STUDY_FAULTS).index(check)}"
    with pytest.raises(AssertionError):
        getattr(declared(monkeypatch, tmp_path, name, *STUDY_FAULTS[check], honest=STUDY), check)()
