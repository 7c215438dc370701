"""What a diagnosis costs: the whole library beside fits of the right structure alone, seven joints, and a first run."""

from __future__ import annotations

import contextlib
import io
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from harness import Row, alternate, row
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

import gapcert as gc
from exams.hidden.draw import noise
from exams.hidden.laws import Hidden
from exams.hidden.log import logged, recording
from exams.hidden.rig import Rig, rig
from exams.sit import model

PERIOD, SECONDS, TRUE = 0.005, 16.0, 0.1
SEQUENCE = 200  # samples, 1 s
ROD = """<mujoco><option timestep="{period}" integrator="implicitfast"/><worldbody><body>
<joint name="q" type="hinge" axis="0 -1 0"/><inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/></body></worldbody>
<actuator><motor name="u" joint="q"/></actuator><sensor><jointpos name="q" joint="q"/></sensor></mujoco>"""
CHILD = "import sys; sys.path.insert(0, sys.argv[1]); from exams import cost; cost.whole(*cost.pendulum())"


def _recorded(name: str, site: str, seconds: float) -> tuple[Rig, gc.Recording]:
    made = rig(name, "multisine", PERIOD, seconds, np.random.default_rng(0))
    motion = made.play((Hidden("viscous-friction", site, {"coefficient": TRUE}),))
    return made, recording(logged(made, motion, noise(made, 0.01, both=False), {}, np.random.default_rng(1)), "zero")


def pendulum() -> tuple[gc.Model, gc.Recording]:
    made, log = _recorded("pendulum", "q", SECONDS)
    return model(made.plant.section(PERIOD)), log


def whole(f: gc.Model, log: gc.Recording, site: str = "q") -> gc.Diagnosis:
    """Everything in the library, everywhere; a wrong answer has no cost worth telling."""
    found = gc.diagnose(f, log, horizons=[0.5])
    if (found.causes[0].effect, found.causes[0].site) != ("viscous-friction", site):
        raise SystemExit(f"cost: {[(c.effect, c.site) for c in found.causes]} was named; viscous-friction at {site} was hidden")
    return found


def sysid(log: gc.Recording, optimizer: Literal["mujoco", "scipy"] = "mujoco") -> Callable[[], float]:
    """mujoco.sysid with the damping of the joint as its one parameter, sequences of 1 s from smoothed starts, one thread.

    optimizer: its own by default; the other that it offers is scipy's, on its rollouts.
    """
    import mujoco
    from mujoco import sysid as peer

    spec = mujoco.MjSpec.from_string(ROD.format(period=PERIOD))
    compiled, (tr,) = spec.compile(), log.trajectories
    y, u = tr.channels["q"], tr.channels["u"][:, None]
    q, v = (savgol_filter(y, 13, 3, deriv=d, delta=PERIOD) for d in (0, 1))
    t, starts = np.arange(SEQUENCE) * PERIOD, range(0, round(0.75 * len(y)) - SEQUENCE, SEQUENCE)

    def damp(spec: Any, p: Any) -> None:
        joint = spec.joint("q")
        value = float(np.ravel(p.value)[0])
        joint.damping = np.array([value, 0.0, 0.0]) if np.ndim(joint.damping) else value

    sequences = peer.ModelSequences(
        "pendulum",
        spec,
        [f"s{k}" for k in starts],
        [peer.create_initial_state(compiled, q[k : k + 1], v[k : k + 1]) for k in starts],
        [peer.TimeSeries(t, u[k : k + SEQUENCE]) for k in starts],
        [peer.TimeSeries(t, y[k : k + SEQUENCE, None], {"q": (peer.SignalType.MjSensor, np.array([0]))}) for k in starts],
    )

    def run() -> float:
        parameter = peer.Parameter("damping", 0.02, 0.0, 2.0, modifier=damp)
        residual = peer.build_residual_fn(models_sequences=[sequences], n_threads=1)
        with contextlib.redirect_stdout(io.StringIO()):
            best, _ = peer.optimize(peer.ParameterDict({"damping": parameter}), residual, optimizer=optimizer, verbose=False)
        return float(np.ravel(best["damping"].value)[0])

    return run


def scipy_fit(f: gc.Model, log: gc.Recording) -> Callable[[], float]:
    """scipy's least squares over the friction and all starts, on our own compiled rollout."""
    effect = gc.registry().build("effect", "viscous-friction")
    extended, (tr,) = f.extend([effect.extension("q", f)]), log.trajectories
    y, u = tr.channels["q"], tr.channels["u"]
    rows = np.arange(0, round(0.75 * len(y)) - SEQUENCE, SEQUENCE)[:, None] + np.arange(SEQUENCE)
    smooth = np.stack([savgol_filter(y, 13, 3, deriv=d, delta=PERIOD) for d in (0, 1)], axis=-1)[rows[:, 0]]
    (name,) = (p.name for p in effect.named("q", f))
    w, inputs = len(rows), u[rows][:, :-1, None]

    def residual(z: np.ndarray) -> np.ndarray:
        path = extended.fast_rollout(z[1:].reshape(w, 2), inputs, parameters={name: np.full(w, z[0])}).x
        return np.asarray((path[..., 0] - y[rows]).ravel())

    # Each start moves its own window alone: differences need three rollouts, not one per number.
    pattern = np.zeros((w * SEQUENCE, 1 + 2 * w), dtype=bool)
    pattern[:, 0] = True
    for i in range(w):
        pattern[i * SEQUENCE : (i + 1) * SEQUENCE, 1 + 2 * i : 3 + 2 * i] = True

    def run() -> float:
        start = np.concatenate([[0.02], smooth.ravel()])
        return float(least_squares(residual, start, jac_sparsity=pattern, method="trf", x_scale="jac").x[0])

    return run


def cold() -> tuple[float, float]:
    """CPU seconds of a process that diagnoses once: with no compiled code at hand, and with it."""
    here = str(Path(__file__).parents[1])
    seconds = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, "-c", CHILD, here], check=True, env=os.environ | {"NUMBA_CACHE_DIR": cache})
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return seconds[0], seconds[1]


def measure(quick: bool) -> list[Row]:
    f, log = pendulum()
    peers = {
        "mujoco.sysid": sysid(log),
        "mujoco.sysid with scipy's optimizer": sysid(log, "scipy"),
        "scipy's least squares": scipy_fit(f, log),
    }
    rows, limit = [], 0.0
    for name, fit in peers.items():
        error = abs(fit() / TRUE - 1)
        ours, peer = alternate(lambda: whole(f, log), fit, repeats=1 if quick else 5)
        what = f"{name}, the right structure alone ({100 * error:.2g} % off)"
        rows.append(row("one joint, the whole library", "time", "s CPU", ours, peer, what))
        limit = limit or peer
    if not quick:
        made, seven = _recorded("chain", "q2", SECONDS)
        chain = model(made.plant.section(PERIOD))
        ours, _ = alternate(lambda: whole(chain, seven, "q2"), lambda: None, repeats=1)
        rows.append(row("seven joints, the whole library", "time", "s CPU", ours, 20 * limit, "20 × mujoco.sysid at one joint"))
        first, later = cold()
        rows.append(row("a first run, nothing compiled yet", "time", "s CPU more", first - later, 30.0, "goal"))
    return rows
