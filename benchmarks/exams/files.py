"""What a diagnosis costs where a robot file is the simulation: three faults of a seven-joint arm, found in one log; and its
last fit beside mujoco.sysid's on the same file.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from harness import Row, alternate, row
from scipy.signal import savgol_filter

import gapcert as gc
import gapcert_engines
from exams.sit import timed
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import Fit, fit
from gapcert_diagnosis.search.candidates import Library

MODELS = Path(__file__).parents[2] / "specs" / "models"
PERIOD, SUBSTEPS, SECONDS, NOISE = 0.004, 2, 20.0, 0.01
ROD = f"""<mujoco><option timestep="{PERIOD}" integrator="implicitfast"/><worldbody><body name="rod">
<joint name="q" axis="0 -1 0"/><inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/></body></worldbody>
<actuator><motor name="u" joint="q"/></actuator><sensor><jointpos name="q" joint="q"/></sensor></mujoco>"""
JOINTS = tuple(f"j{k}" for k in range(1, 8))
ENOUGH, WINDOW = 16_000, 0.8  # what diagnose() fits: measured values, and s in a window of several coordinates


@final
@dataclass(frozen=True)
class Fault:
    """A native parameter that the real arm has otherwise, and what that is called."""

    native: str
    added: float
    effect: str
    site: str


HIDDEN = (
    Fault("damping.j2", 1.5, "viscous-friction", "j2"),
    Fault("frictionloss.j4", 1.2, "coulomb-friction", "j4"),
    Fault("armature.j6", 0.03, "parameter", "armature_j6"),
)


def backend(file: Path, joints: Sequence[str], **options: Any) -> gapcert_engines.EngineBackend:
    """A robot in MuJoCo: joint j has the states j and j_dot, and the input u_j."""
    known = gc.registry()
    config: Any = known.config("backend", "mujoco")
    section = {
        "robot": str(file),
        "states": {f"{j}{end}": f"{j}.{kind}" for kind, end in (("position", ""), ("velocity", "_dot")) for j in joints},
        "inputs": {f"u_{j}": j for j in joints},
        "period": f"{PERIOD} s",
    }
    built: gapcert_engines.EngineBackend = known.build(
        "backend", "mujoco", config.model_validate(section | options), gc.Context()
    )
    return built


def simulation(robot: gapcert_engines.EngineBackend, tolerance: float = 0.02) -> gapcert_engines.EngineModel:
    """The robot as its file says, with masses known to within `tolerance`."""
    loose = [p for p in robot.parameters if p.name.startswith("mass.")] if tolerance else []
    stated = [gc.Parameter(p.name, p.value, p.unit, tolerance * p.value, p.low, p.high) for p in loose]
    return gapcert_engines.EngineModel(robot, stated)


def real(robot: gapcert_engines.EngineBackend, faults: Sequence[Fault]) -> dict[str, np.ndarray]:
    """Native parameters of the robot with its faults."""
    stated = {p.name: p.value for p in robot.parameters}
    return {f.native: np.array([stated[f.native] + f.added]) for f in faults}


def tracked(
    robot: gapcert_engines.EngineBackend, faults: Sequence[Fault], seconds: float = SECONDS, seed: int = 0
) -> gc.Recording:
    """Seven joints that follow sums of slow sines under a controller, as measured: noise of 1 % of each channel's deviation."""
    rng, n, count = np.random.default_rng(seed), len(JOINTS), round(seconds / PERIOD)
    t = np.arange(count) * PERIOD
    f, phase = rng.uniform(0.1, 0.7, (n, 5)), rng.uniform(0, 2 * np.pi, (n, 5))
    wave = 2 * np.pi * f[..., None] * t + phase[..., None]
    middle = np.array([0.0, 0.6, 0.0, 1.2, 0.0, 0.8, 0.0])
    q = middle + 0.28 * np.sin(wave).sum(axis=1).T
    v = 0.28 * (2 * np.pi * f[..., None] * np.cos(wave)).sum(axis=1).T
    stiff = np.array([600.0, 600, 400, 400, 120, 80, 40])
    x, u = np.empty((count, 2 * n)), np.empty((count, n))
    given, now = real(robot, faults), np.concatenate([q[0], v[0]])
    for k in range(count):
        x[k] = now
        u[k] = stiff * (q[k] - now[:n]) + 0.08 * stiff * (v[k] - now[n:])
        now = robot.step(now[None], u[k][None], parameters=given or None).x[0]
    y = x + NOISE * x.std(axis=0) * rng.standard_normal(x.shape)
    named = {s.name: y[:, i] for i, s in enumerate(robot.states)} | {s.name: u[:, i] for i, s in enumerate(robot.inputs)}
    return gc.Recording.of(t, named, hold="zero")


def structure(model: gc.Model, log: gc.Recording, faults: Sequence[Fault], window: float = WINDOW) -> Callable[[], Fit]:
    """The fit of the right structure from its stated start, on the windows that a diagnosis fits."""
    effects = [gc.registry().build("effect", name) for name in dict.fromkeys(f.effect for f in faults)]

    def run() -> Fit:
        library = Library(model, Dataset.of(model, log.split({"last": 0.25})[0]), effects)
        windows = library.measured.windows(library.measured.samples(window)).thinned(ENOUGH)
        known = {c.key: c for c in library.candidates}
        return fit(library.hypothesis(tuple(known[f.effect, f.site] for f in faults)), windows)

    return run


@final
@dataclass(frozen=True)
class Told:
    """A robot of which both sides know the file and what is wrong in it, and not how much."""

    text: str
    joints: tuple[str, ...]
    faults: tuple[Fault, ...]
    efforts: tuple[float, ...]
    window: float

    @classmethod
    def rod(cls) -> Told:
        return cls(ROD, ("q",), (Fault("damping.q", 0.1, "viscous-friction", "q"),), (2.0,), 1.2)

    @classmethod
    def arm(cls) -> Told:
        text = (MODELS / "arm.xml").read_text().replace('timestep="0.002"', f'timestep="{PERIOD}"')
        sensors = "".join(f'<jointpos name="{j}" joint="{j}"/>' for j in ("shoulder", "elbow"))
        damped = Fault("damping.shoulder", 0.15, "viscous-friction", "shoulder")
        dry = Fault("frictionloss.elbow", 0.08, "coulomb-friction", "elbow")
        text = text.replace("</mujoco>", f"<sensor>{sensors}</sensor></mujoco>")
        return cls(text, ("shoulder", "elbow"), (damped, dry), (3.0, 0.8), 0.8)

    def made(self, folder: Path) -> tuple[gapcert_engines.EngineBackend, gc.Recording]:
        """The robot, and a log of its positions with noise of 1 %."""
        (folder / "robot.xml").write_text(self.text)
        robot, n = backend(folder / "robot.xml", self.joints), len(self.joints)
        u = np.hstack([multisine(SECONDS, PERIOD, a, (0.2, 2.0), k) for k, a in enumerate(self.efforts)])
        x = robot.rollout(np.zeros((1, 2 * n)), u[None], parameters=real(robot, self.faults)).x[0, :-1, :n]
        y = x + NOISE * x.std(axis=0) * np.random.default_rng(0).standard_normal(x.shape)
        columns = {j: y[:, i] for i, j in enumerate(self.joints)} | {f"u_{j}": u[:, i] for i, j in enumerate(self.joints)}
        return robot, gc.Recording.of(np.arange(len(u)) * PERIOD, columns, hold="zero")

    def off(self, values: Mapping[str, float]) -> float:
        """The largest relative error of what was added to the file's numbers."""
        return max(abs(values[f.native] / f.added - 1) for f in self.faults)


def sysid(told: Told, log: gc.Recording, optimizer: Literal["mujoco", "scipy"]) -> Callable[[], dict[str, float]]:
    """mujoco.sysid with the same file and the names of what is wrong in it: sequences of 1 s, smoothed starts, one thread."""
    import mujoco
    from mujoco import sysid as peer

    spec = mujoco.MjSpec.from_string(told.text)
    compiled, (tr,) = spec.compile(), log.trajectories
    y, u = (np.stack([tr.channels[f"{p}{j}"] for j in told.joints], axis=1) for p in ("", "u_"))
    q, v = (savgol_filter(y, 13, 3, deriv=d, delta=PERIOD, axis=0) for d in (0, 1))
    length = round(1.0 / PERIOD)
    t, starts = np.arange(length) * PERIOD, range(0, round(0.75 * len(y)) - length, length)
    signals = {j: (peer.SignalType.MjSensor, np.array([i])) for i, j in enumerate(told.joints)}
    stated = {f.native: float(np.ravel(_own(spec, f.native))[0]) for f in told.faults}
    sequences = peer.ModelSequences(
        "robot",
        spec,
        [f"s{k}" for k in starts],
        [peer.create_initial_state(compiled, q[k], v[k]) for k in starts],
        [peer.TimeSeries(t, u[k : k + length]) for k in starts],
        [peer.TimeSeries(t, y[k : k + length], signals) for k in starts],
    )

    def run() -> dict[str, float]:
        free = peer.ParameterDict(
            {
                f.native: peer.Parameter(f.native, stated[f.native] + 0.02, 0.0, 5.0, modifier=_setter(f.native))
                for f in told.faults
            }
        )
        residual = peer.build_residual_fn(models_sequences=[sequences], n_threads=1)
        with contextlib.redirect_stdout(io.StringIO()):
            best, _ = peer.optimize(free, residual, optimizer=optimizer, verbose=False)
        return {n: float(np.ravel(best[n].value)[0]) - stated[n] for n in stated}

    return run


def _own(spec: Any, native: str) -> Any:
    what, _, joint = native.partition(".")
    return getattr(spec.joint(joint), what)


def _setter(native: str) -> Callable[[Any, Any], None]:
    what, _, name = native.partition(".")

    def put(spec: Any, p: Any) -> None:
        value = float(np.ravel(p.value)[0])
        joint = spec.joint(name)
        setattr(joint, what, np.array([value, 0.0, 0.0]) if np.ndim(getattr(joint, what)) else value)

    return put


def beside(case: str, told: Told, quick: bool) -> list[Row]:
    """Our fit and each of mujoco.sysid's optimizers: how far off, and how long."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        robot, log = told.made(Path(folder))
        ours = structure(simulation(robot, 0.0), log, told.faults, told.window)
        found = ours()
        mine = dict(zip((f.native for f in told.faults), map(float, found.theta), strict=True))
        optimizers: tuple[Literal["mujoco", "scipy"], ...] = ("mujoco", "scipy")
        for optimizer in optimizers:
            theirs = sysid(told, log, optimizer)
            what = f"mujoco.sysid, its optimizer {optimizer!r}"
            rows.append(row(case, "error of what was hidden", "%", 100 * told.off(mine), 100 * told.off(theirs()), what))
            rows.append(row(case, "time of the last fit", "s CPU", *alternate(ours, theirs, repeats=1 if quick else 5), what))
    return rows


def seven(limit: float) -> list[Row]:
    """Three faults of an arm, by the whole library, beside the fit of the right structure alone; limit: CPU seconds."""
    case, robot = "robot file of seven joints, the whole library", backend(MODELS / "arm7.xml", JOINTS, substeps=SUBSTEPS)
    model, log = simulation(robot), tracked(robot, HIDDEN)
    alone = structure(model, log, HIDDEN)
    alone()
    refit, _ = alternate(alone, lambda: None, repeats=3)
    goal = "20 × the fit of the right structure alone"
    record = timed(lambda: {"found": gc.diagnose(model, log, horizons=[0.5])}, limit)
    ours = record["cpu"]
    if "error" in record:
        return [Row(case, f"no answer: {record['error']}", "s CPU", ours, 20 * refit, goal, None)]
    named, hidden = {(c.effect, c.site) for c in record["found"].causes}, {(f.effect, f.site) for f in HIDDEN}
    return [
        row(case, "hidden faults that are named", "of 3", len(named & hidden), 3, "goal", less_is_better=False),
        Row(case, "others that are named", "causes", len(named - hidden), 0, "goal", None),
        row(case, "time", "s CPU", ours, 20 * refit, goal),
    ]


def measure(quick: bool, limit: float) -> list[Row]:
    rows = beside("robot file, one joint, structure given", Told.rod(), quick)
    rows += beside("robot file, two joints, structure given", Told.arm(), quick)
    return rows if quick else rows + seven(limit)
