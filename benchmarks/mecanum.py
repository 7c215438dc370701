"""One mecanum base in every engine of specs/mecanum_engines.yaml: how far it falls behind p + τ u from rest, and in motion.

From rest, every wheel grips along its rollers only, with at most μ m g / 4: along (1, ±1) / √2 the base speeds up by at most
a = μ g / 2 and so falls behind by w² / (2 a), w the command's part in that direction. `a` is fitted to each engine. In motion,
the same commands follow random ones. `--write` renews docs/benchmarks/mecanum.md and docs/images/mecanum.svg. An engine that is
not installed is left out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import harness
import numpy as np
import numpy.typing as npt

import gapcert

Array = npt.NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
SPEC = ROOT / "specs" / "mecanum_engines.yaml"
STATES = {"px": "base.x", "py": "base.y", "vx": "base.vx", "vy": "base.vy"}
THEORY = 1.0 * 9.81 / 2
TOWARDS = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
"""Unit vectors along which two of the wheels grip."""
PUBLISHED = "| published (arXiv 2506.17675), Gazebo | | 0.11 | 0.08 | | | | | | | | | | |"
HEADER = (
    "engine | CPU ms per transition | η₁ / m | η₂ / m | gap at (1, 0) | at (0, 1) | at (1, 1) | a / (m/s²) | explained "
    "| slowest / command | heading / mrad | above η in motion | worst | reversal"
)


@dataclass(frozen=True)
class Figures:
    """One engine's row. Gaps |p⁺ − p − τ u| in m, from rest over a grid of [−1, 1]²: `eta` per axis, `corners` the larger axis
    at (1, 0), (0, 1), (1, 1). `a` in m/s² fits them and explains the share `explained` of Σ gap². `reached`: the least of
    velocity / command at the end; `heading`: the largest |yaw|. In motion: the share `above` eta of `transitions`, the `worst`
    gap, and that of (−1, −1) followed by (1, 1). `sweep`: (velocity before, gap along x under ux = 1); `cloud`: (change of the
    command, gap).
    """

    engine: str
    ms: float
    eta: tuple[float, float]
    corners: tuple[float, ...]
    a: float
    explained: float
    reached: float
    heading: float
    transitions: int
    above: float
    worst: float
    reversal: float
    sweep: list[tuple[float, float]]
    cloud: list[tuple[float, float]]


def engines(names: list[str]) -> Iterator[tuple[str, gapcert.System]]:
    """The backends of the spec that are installed here, with velocities among their states."""
    asked = gapcert.load_spec(SPEC).config.sections["compare"]
    assert asked is not None
    for name, config in asked.backends.items():
        if name not in asked.unavailable and (not names or name in names):
            config = config.model_copy(update={"states": STATES})
            yield name, gapcert.registry().build("backend", config.kind, config, gapcert.Context(folder=SPEC.parent))


def rotation(system: gapcert.System, hidden: Array) -> Array:
    """The base's heading, rad (n,)."""
    sizes = np.cumsum([0, *(s.size for s in system.hidden)])
    at = sizes[[s.name for s in system.hidden].index("base.rotation")]
    w, x, y, z = hidden[:, at : at + 4].T
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def law(u: Array) -> Array:
    """(n, 2): the gap from rest times −2 a, per axis."""
    w = u @ TOWARDS.T
    return np.asarray((w * np.abs(w)) @ TOWARDS)


def figures(name: str, system: gapcert.System, quick: bool) -> Figures:
    tau, cheap = system.period, name in ("mujoco-surface", "gazebo-spheres")
    side = np.linspace(-1, 1, 3 if quick else 5)
    u = np.array([(a, b) for a in side for b in side if (a, b) != (0, 0)])
    start = time.process_time()
    after = system.step(np.zeros((len(u), 4)), u)
    ms = (time.process_time() - start) / len(u) * 1e3
    assert after.hidden is not None
    gap = after.x[:, :2] - tau * u
    shape = law(u)
    slope = float((shape * gap).sum() / (shape**2).sum())
    explained = 1 - float(((gap - slope * shape) ** 2).sum() / (gap**2).sum())
    eta = np.abs(gap).max(axis=0)
    pushed = np.abs(u) > 0
    runs, steps = (3 if quick else 10), (10 if cheap else 5)
    commands = np.random.default_rng(0).uniform(-1, 1, (runs, steps + 1, 2))
    x = system.rollout(np.zeros((runs, 4)), commands).x
    moving = (np.diff(x[:, :, :2], axis=1) - tau * commands)[:, 1:].reshape(-1, 2)
    change = np.diff(commands, axis=1).reshape(-1, 2)
    turned = np.array([[[-1.0, -1.0], [-1.0, -1.0], [1.0, 1.0]]])
    back = system.rollout(np.zeros((1, 4)), turned).x[0, :, :2]
    return Figures(
        name,
        ms,
        (float(eta[0]), float(eta[1])),
        tuple(float(np.abs(gap[(u == c).all(axis=1)]).max()) for c in ((1, 0), (0, 1), (1, 1))),
        -0.5 / slope,
        explained,
        float((after.x[:, 2:] / np.where(pushed, u, 1))[pushed].min()),
        float(np.abs(rotation(system, after.hidden)).max()),
        len(moving),
        float((np.abs(moving) > eta).any(axis=1).mean()),
        float(np.abs(moving).max()),
        float(np.abs(back[3] - back[2] - tau).max()),
        sweep(system, 5 if quick else 9) if cheap else [],
        list(zip(np.abs(change).max(axis=1).tolist(), np.abs(moving).max(axis=1).tolist(), strict=True)),
    )


def sweep(system: gapcert.System, n: int) -> list[tuple[float, float]]:
    """(velocity, gap along x): two periods of one command along x, then ux = 1."""
    before = np.linspace(-1, 1, n)
    commands = np.zeros((n, 3, 2))
    commands[:, :2, 0], commands[:, 2, 0] = before[:, None], 1.0
    x = system.rollout(np.zeros((n, 4)), commands).x
    gap = np.abs(x[:, 3, 0] - x[:, 2, 0] - system.period)
    return list(zip(x[:, 2, 2].tolist(), gap.tolist(), strict=True))


def table(rows: list[Figures]) -> str:
    """The rows as a Markdown table, with the published one at its end."""
    columns = HEADER.count("|") + 1
    lines = [f"| {HEADER} |", "|" + " --- |" + " ---: |" * (columns - 1)]
    for r in rows:
        gaps = (f"{v:.3f}" for v in (*r.eta, *r.corners))
        share = f"{100 * r.above:.0f} % of {r.transitions}"
        cells = [r.engine, f"{r.ms:.1f}", *gaps, f"{r.a:.3f}", f"{100 * r.explained:.2f} %", f"{r.reached:.2f}"]
        lines.append("| " + " | ".join([*cells, f"{1e3 * r.heading:.1f}", share, f"{r.worst:.3f}", f"{r.reversal:.3f}"]) + " |")
    return "\n".join([*lines, PUBLISHED])


def picture(rows: list[Figures], path: Path) -> None:
    """Left: the gap along x under ux = 1 against the velocity before. Right: gaps of random commands against their change."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "font.size": 9,
            "svg.hashsalt": "gapcert",
            "svg.fonttype": "none",
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    )
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    v = np.linspace(-1, 1, 201)
    left.plot(v, np.sqrt(2) * ((1 - v) / np.sqrt(2)) ** 2 / (2 * THEORY), color="0.6", lw=1, label="(1 − v)² / (2√2 · μg/2)")
    colours = dict(zip((r.engine for r in rows), ("#1f5fa8", "#2f8f5b", "#b0562b", "#8a4fa0", "#c08a1e"), strict=False))
    for r in rows:
        if r.sweep:
            left.plot(*zip(*r.sweep, strict=True), "o", ms=4, color=colours[r.engine], label=r.engine)
            left.axhline(r.eta[0], color=colours[r.engine], ls="--", lw=0.8)
        right.plot(*zip(*r.cloud, strict=True), "o", ms=3, alpha=0.7, mew=0, color=colours[r.engine], label=r.engine)
    surest = max(r.eta[0] for r in rows if r.sweep)
    left.annotate("η from rest, over all commands", (1.0, surest), (0, 4), textcoords="offset points", ha="right", color="0.3")
    left.axvline(0, color="0.85", lw=0.8, zorder=0)
    left.set(xlabel="velocity before the command, m/s", ylabel="gap of px under ux = 1, m", ylim=(0, None))
    right.set(xlabel="largest change of the command, m/s", ylabel="gap, larger of the two axes, m", ylim=(0, None))
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("engines", nargs="*", metavar="ENGINE", help="names in the spec; all that are installed")
    parser.add_argument("--quick", action="store_true", help="at most three minutes; fewer commands")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--write", action="store_true", help="renew the documentation's table and picture")
    options = parser.parse_args()
    here = harness.machine()
    rows = [figures(name, system, options.quick) for name, system in engines(options.engines)]
    text = f"{', '.join(f'{k}: {v}' for k, v in here.items())}\n\n{table(rows)}\n"
    print(json.dumps({"machine": here, "rows": [asdict(r) for r in rows]}, indent=2) if options.json else text, end="")
    if options.write:
        (ROOT / "docs/benchmarks/mecanum.md").write_text(text, encoding="utf-8")
        picture(rows, ROOT / "docs/images/mecanum.svg")


if __name__ == "__main__":
    main()
