"""Diagnosis against its peers on the same recordings: PySINDy finds terms without rivals, mujoco.sysid is told the structure.

Recordings are those of the exams (a pendulum under torque, one hidden law). mujoco.sysid gets the right structure with one free
number, in sequences of 1 s from smoothed starts; so does SciPy's least squares on our compiled rollout. PySINDy gets the
acceleration that the nominal model lacks, and eleven terms with the right one among them; of all its settings the best counts.

The peers are not among our requirements: pip install pysindy "mujoco[sysid]".
"""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from exams.hidden import draw
from exams.sit import diagnosed, model
from harness import Row, main, row
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

import gapcert as gc

Array = np.ndarray[Any, np.dtype[np.float64]]
LAWS = ("viscous-friction", "coulomb-friction", "quadratic-drag", "linear-spring", "cubic-spring", "constant-force")
IN_MUJOCO = {"viscous-friction": "damping", "coulomb-friction": "frictionloss", "linear-spring": "stiffness"}
TERMS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "constant-force": lambda q, v, u: np.ones_like(q),
    "viscous-friction": lambda q, v, u: v,
    "coulomb-friction": lambda q, v, u: np.tanh(50 * v / np.std(v)),
    "quadratic-drag": lambda q, v, u: v * np.abs(v),
    "linear-spring": lambda q, v, u: q,
    "cubic-spring": lambda q, v, u: q**3,
    "sin q": lambda q, v, u: np.sin(q),
    "cos q": lambda q, v, u: np.cos(q),
    "u": lambda q, v, u: u,
    "v^3": lambda q, v, u: v**3,
    "|u| sgn v": lambda q, v, u: np.abs(u) * np.tanh(50 * v / np.std(v)),
}
SEQUENCE, SMOOTHING = 1.0, 0.03  # s


def cases(seed: int, count: int) -> list[draw.Case]:
    """Clear cases of laws that every peer could express, on the pendulum, with an input."""
    found: list[draw.Case] = []
    index = 0
    while len(found) < count and index < 100 * count:
        case = draw.single("peers", seed, index, ("pendulum",))
        law = case.hidden[0].effect
        if law in LAWS and case.label == "clear" and case.rig.excitation not in ("decay", "tracking") and not case.noise.colour:
            found.append(case)
        index += 1
    return found


def smoothed(case: draw.Case, recording: gc.Recording) -> tuple[Array, Array, Array, Array, Array]:
    """t, angle, velocity, acceleration, input."""
    (log,) = recording.trajectories
    dt, q = case.rig.period, np.unwrap(log.channels["q"])
    width = 2 * max(2, round(SMOOTHING / dt)) + 1
    v, a = (savgol_filter(q, width, 3, deriv=k, delta=dt) for k in (1, 2))
    return log.t, savgol_filter(q, width, 3), v, a, log.channels["u"]


def by_sysid(case: draw.Case, recording: gc.Recording) -> tuple[float, float]:
    """(number, CPU seconds) of the one free parameter."""
    import mujoco
    from mujoco import sysid

    law = IN_MUJOCO[case.hidden[0].effect]
    t, q, v, _, u = smoothed(case, recording)
    stated = {k: float(p["value"].split()[0]) for k, p in case.model["parameters"].items() if isinstance(p, dict)}
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option><worldbody><body>
        <joint name="q" axis="0 -1 0"/><inertial pos="0 0 {-stated["c"]}" mass="{stated["m"]}"
        diaginertia="{stated["J"]} {stated["J"]} 0.001"/></body></worldbody>
        <actuator><motor joint="q"/></actuator><sensor><jointpos joint="q" name="angle"/></sensor></mujoco>"""
    )
    compiled, n = spec.compile(), round(SEQUENCE / case.rig.period)
    names, starts, controls, sensed = [], [], [], []
    for k in range(0, len(t) - n + 1, n):
        part, own = slice(k, k + n), t[k : k + n] - t[k]
        names.append(str(k))
        starts.append(sysid.create_initial_state(compiled, q[k : k + 1], v[k : k + 1], np.zeros(0)))
        controls.append(sysid.TimeSeries(own, u[part, None]))
        measured = np.unwrap(recording.trajectories[0].channels["q"])
        sensed.append(sysid.TimeSeries.from_names(own, measured[part, None], compiled))
    sequences = sysid.ModelSequences("rod", spec, names, starts, controls, sensed)
    free = sysid.ParameterDict()

    def put(s: Any, p: Any) -> None:
        value = float(p.value[0])
        setattr(s.joint("q"), law, value if law == "frictionloss" else np.array([value, 0.0, 0.0]))

    free.add(sysid.Parameter(law, nominal=0.05, min_value=0.0, max_value=20.0, modifier=put))
    start = time.process_time()
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    with contextlib.redirect_stdout(io.StringIO()):
        fitted, _ = sysid.optimize(initial_params=free, residual_fn=residual, optimizer="mujoco", verbose=False)
    return float(fitted[law].value[0]), time.process_time() - start


def by_least_squares(case: draw.Case, recording: gc.Recording) -> tuple[float, float]:
    """(number, CPU seconds): the right law on our compiled rollout, from the same starts."""
    nominal, hidden = model(case.model), case.hidden[0]
    effect = gc.registry().build("effect", hidden.effect)
    extended = nominal.extend([effect.extension(hidden.site, nominal)])
    name = effect.named(hidden.site, nominal)[0].name
    t, q, v, _, u = smoothed(case, recording)
    n = round(SEQUENCE / case.rig.period)
    rows = np.arange(0, len(t) - n + 1, n)
    x0, inputs = np.stack([q[rows], v[rows]], axis=1), np.stack([u[k : k + n - 1, None] for k in rows])
    measured = np.stack([np.unwrap(recording.trajectories[0].channels["q"])[k : k + n] for k in rows])

    def residual(theta: Array) -> Array:
        path = extended.fast_rollout(x0, inputs, parameters={name: float(theta[0])}).x
        return np.asarray((path[:, :, 0] - measured).ravel())

    start = time.process_time()
    fitted = least_squares(residual, [0.05], diff_step=1e-3)
    return float(fitted.x[0]), time.process_time() - start


def by_sindy(case: draw.Case, recording: gc.Recording) -> list[set[str]]:
    """The terms that PySINDy's STLSQ keeps of the acceleration that the nominal model lacks, per setting."""
    from pysindy.optimizers import STLSQ

    nominal = model(case.model)
    t, q, v, a, u = smoothed(case, recording)
    x, inside = np.stack([q, v], axis=1), slice(20, len(t) - 20)
    still = nominal.step(x, u[:, None]).x[:, 1] - v
    missing = (a - still / nominal.period)[inside, None]
    columns = np.stack([f(q, v, u)[inside] for f in TERMS.values()], axis=1)
    size = np.sqrt(np.mean(columns**2, axis=0))
    kept = []
    for share in (0.02, 0.05, 0.1, 0.2, 0.5):
        for ridge in (1e-6, 1e-2, 1.0):
            level = share * float(np.sqrt(np.mean(missing**2)))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a setting that keeps nothing says so each time
                found = STLSQ(threshold=level, alpha=ridge).fit(columns / size, missing).coef_[0]
            kept.append({n for n, c in zip(TERMS, found, strict=True) if c})
    return kept


def measure(options: argparse.Namespace) -> list[Row]:
    drawn = cases(options.seed, options.cases or (3 if options.quick else 12))
    ours: list[tuple[set[str], float, float]] = []
    peers: dict[str, list[tuple[float, float]]] = {"mujoco.sysid": [], "SciPy least squares": []}
    alone: list[float] = []
    terms: list[list[set[str]]] = []
    diagnosed(drawn[0])  # the compiled rollout is on disk after the first run
    for case in drawn:
        recording, hidden = case.recording(), case.hidden[0]
        (truth,) = hidden.numbers.values()
        start = time.process_time()
        found = diagnosed(case, recording=recording)
        spent = time.process_time() - start
        mine = {c.effect: c for c in found.causes}
        value = next(iter(mine[hidden.effect].parameters.values())).value if hidden.effect in mine else np.nan
        ours.append((set(mine), abs(value / truth - 1), spent))
        terms.append(by_sindy(case, recording))
        peers["SciPy least squares"].append(_off(by_least_squares(case, recording), truth))
        if hidden.effect in IN_MUJOCO:
            peers["mujoco.sysid"].append(_off(by_sysid(case, recording), truth))
            alone.append(spent)
    return list(_rows(drawn, ours, peers, alone, terms))


def _off(answer: tuple[float, float], truth: float) -> tuple[float, float]:
    return abs(answer[0] / truth - 1), answer[1]


def _rows(
    drawn: Sequence[draw.Case],
    ours: Sequence[tuple[set[str], float, float]],
    peers: dict[str, list[tuple[float, float]]],
    alone: Sequence[float],
    terms: Sequence[list[set[str]]],
) -> list[Row]:
    right = [names == {c.hidden[0].effect} for c, (names, _, _) in zip(drawn, ours, strict=True)]
    best = max(sum(t[k] == {c.hidden[0].effect} for c, t in zip(drawn, terms, strict=True)) for k in range(len(terms[0])))
    error = 100 * statistics.median(e for e, ok in zip((o[1] for o in ours), right, strict=True) if ok)
    title = f"{len(drawn)} hidden laws"
    out = [
        row(title, "right name and nothing else", "cases", sum(right), best, "PySINDy, its best setting", less_is_better=False),
    ]
    for name, found in peers.items():
        spent = alone if name == "mujoco.sysid" else [o[2] for o in ours]
        told = f"{name}, told the law"
        out.append(row(title, "parameter error, median", "%", error, 100 * statistics.median(f[0] for f in found), told))
        out.append(
            row(
                "whole library at one joint",
                "time",
                "CPU s",
                statistics.median(spent),
                statistics.median(f[1] for f in found),
                told,
            )
        )
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of the recordings")
    parser.add_argument("--cases", type=int, help="number of recordings")
    main(measure, parser)
