"""Puts effects into data from outside: into the forces and inputs of any System, sharing nothing with what has to find them."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gapcert.errors import UsageError
from gapcert.recording import Recording
from gapcert.system import Array, System

FORCES: dict[str, Callable[[Mapping[str, float], float, float], float]] = {
    "viscous-friction": lambda p, q, v: -p["coefficient"] * v,
    "quadratic-drag": lambda p, q, v: -p["coefficient"] * v * abs(v),
    "cubic-spring": lambda p, q, v: -p["coefficient"] * q**3,
    "constant-force": lambda p, q, v: p["force"],
    "force-law": lambda p, q, v: p["amplitude"] * math.sin(p["periods"] * q),
}
KNOWN = (*FORCES, "coulomb-friction", "input-gain", "input-delay")
Hidden = tuple[str, str, Mapping[str, float]]


def hide(
    system: System,
    effects: Sequence[Hidden] = (),
    *,
    x0: Sequence[float],
    u: Array,
    noise: Mapping[str, float],
    seed: int,
    decimate: int = 1,
) -> Recording:
    """A recording of `system` with effects (name, site, {parameter: value}) that its own equations do not have.

    u (T, nu) is held for one sample each, which is `decimate` periods of the system; it is recorded as commanded. The channels
    of `noise` (state → standard deviation) are measured. Forces are held for a period, so that should be short. The effect
    `force-law` (amplitude·sin(periods·q)) stands for whatever a library does not know.
    """
    if unknown := [name for name, _, _ in effects if name not in KNOWN]:
        raise UsageError(f"hide: cannot hide '{unknown[0]}'; it knows {', '.join(KNOWN)}")
    fine = _input_path(system, effects, np.repeat(np.asarray(u, dtype=np.float64), decimate, axis=0))
    laws = [e for e in effects if not e[0].startswith("input-")]
    x = np.asarray(x0, dtype=np.float64)[None]
    path, hidden = [x[0]], None
    for command in fine[:-decimate]:
        forces = _forces(system, laws, x, command[None], hidden) if laws else None
        step = system.step(x, command[None], hidden=hidden, forces=forces)
        x, hidden = step.x, step.hidden
        path.append(x[0])
    states = np.array(path)[::decimate]
    rng = np.random.default_rng(seed)
    names = [s.name for s in system.states]
    channels = {n: states[:, names.index(n)] + sigma * rng.standard_normal(len(states)) for n, sigma in noise.items()}
    channels |= {s.name: np.asarray(u, dtype=np.float64)[:, i] for i, s in enumerate(system.inputs)}
    return Recording.of(np.asarray(np.arange(len(states)) * system.period * decimate), channels)


def _input_path(system: System, effects: Sequence[Hidden], u: Array) -> Array:
    """What reaches the system (steps, nu): delayed by a whole number of its periods, then multiplied."""
    names, out = [s.name for s in system.inputs], u.copy()
    for name, site, values in effects:
        if name == "input-delay":
            late = round(values["delay"] / system.period)
            column = out[:, names.index(site)].copy()
            out[late:, names.index(site)] = column[: len(column) - late]
            out[:late, names.index(site)] = 0.0
    for name, site, values in effects:
        if name == "input-gain":
            out[:, names.index(site)] *= values["gain"]
    return out


def _forces(system: System, laws: Sequence[Hidden], x: Array, u: Array, hidden: Array | None) -> Array:
    """Forces (1, substeps, nq) of one period. Dry friction stops the joint within it where it can, and else opposes it."""
    force = np.zeros((1, system.substeps, len(system.coordinates)))
    for name, site, values in laws:
        if name != "coulomb-friction":
            q, v = _columns(system, site)
            force[..., system.coordinates.index(site)] += FORCES[name](values, float(x[0, q]), float(x[0, v]))
    for name, site, values in laws:
        if name == "coulomb-friction":
            _, v = _columns(system, site)
            joint = system.coordinates.index(site)
            unit = force.copy()
            unit[..., joint] += 1.0
            free, pushed = (system.step(x, u, hidden=hidden, forces=f).x[0, v] for f in (force, unit))
            # The velocity is affine in the force over one step: this force brings it to zero.
            stop = -free / (pushed - free)
            force[..., joint] += np.clip(stop, -values["level"], values["level"])
    return force


def _columns(system: System, site: str) -> tuple[int, int]:
    """(position, velocity) of a coordinate: states q and q_dot, or else positions first and velocities after."""
    names = [s.name for s in system.states]
    if site in names and f"{site}_dot" in names:
        return names.index(site), names.index(f"{site}_dot")
    q = system.coordinates.index(site)
    return q, q + len(system.coordinates)


def multisine(seconds: float, period: float, amplitude: float, band: tuple[float, float], seed: int) -> Array:
    """(T, 1): ten sines with random phases, frequencies spread evenly over the band in Hz; its largest value is `amplitude`."""
    t = np.arange(round(seconds / period)) * period
    rng = np.random.default_rng(seed)
    phases = zip(np.linspace(*band, 10), rng.uniform(0, 2 * np.pi, 10), strict=True)
    waves = [np.sin(2 * np.pi * f * t + phase) for f, phase in phases]
    total = np.sum(waves, axis=0)
    return np.asarray(amplitude * total / np.abs(total).max())[:, None]


def steps(seconds: float, period: float, amplitude: float, hold: float, seed: int) -> Array:
    """(T, 1): random levels in [−amplitude, amplitude], each held for `hold` s."""
    count, each = round(seconds / period), max(1, round(hold / period))
    levels = np.random.default_rng(seed).uniform(-amplitude, amplitude, -(-count // each))
    return np.repeat(levels, each)[:count, None]


def chirp(seconds: float, period: float, amplitude: float, band: tuple[float, float]) -> Array:
    """(T, 1): a sine whose frequency rises evenly through the band in Hz."""
    t = np.arange(round(seconds / period)) * period
    return np.asarray(amplitude * np.sin(2 * np.pi * (band[0] * t + (band[1] - band[0]) * t**2 / (2 * seconds))))[:, None]


def write_csv(recording: Recording, path: Path | str, digits: int = 9) -> None:
    """One file: column t, then the channels; with several trajectories a column `trajectory` as well."""
    several = len(recording.trajectories) > 1
    with Path(path).open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["t", *recording.names, *(["trajectory"] if several else [])])
        for tr in recording.trajectories:
            for k in range(len(tr)):
                row = [f"{tr.t[k]:.{digits}g}", *(f"{tr.channels[n][k]:.{digits}g}" for n in recording.names)]
                out.writerow([*row, *([tr.name] if several else [])])
