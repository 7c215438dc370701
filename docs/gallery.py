"""The pictures of the documentation, made again by running the specs that they are of.

`python docs/gallery.py` runs what is missing in `runs/gallery` and writes `docs/images/gallery/*.svg`; with names, only those.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import blocks
from standalone import cut, drawn

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"


@dataclass(frozen=True)
class Entry:
    """One picture: the spec that it is of, its title in the report, and what to see in it."""

    name: str
    spec: str
    title: str
    see: str
    heading: str = ""

    @property
    def source(self) -> str:
        """The spec's file, or the page that has it (`docs/PAGE.md:NAME`, of the run NAME)."""
        return self.spec.partition(":")[0]

    @property
    def of_a_page(self) -> bool:
        return self.source.endswith(".md")

    @property
    def command(self) -> str:
        verb = "diagnose" if "/diagnose/" in self.spec else "compare" if Path(self.spec).stem == "compare" else "run"
        return f"gapcert {verb} {self.spec}"


PENDULUM, BOUNCE, MECANUM = "specs/pendulum.yaml", "specs/bounce.yaml", "specs/mecanum.yaml"
ENTRIES = (
    Entry(
        "pendulum-band",
        PENDULUM,
        "Gap of theta along torque",
        "The true gap between Euler's pendulum and PyBullet's, asked afresh, and the certified band around it.",
        "How wrong is a model?",
    ),
    Entry(
        "pendulum-keeps",
        PENDULUM,
        "Runs that keep the specification",
        "All runs of the controller that trusts the model leave the goal; of the one that knows γ, none does.",
    ),
    Entry(
        "pendulum-breaks",
        PENDULUM,
        "How a run without γ breaks",
        "One step of such a run: the model says inside, the simulator ends outside.",
    ),
    Entry(
        "tutorial-elbow",
        "docs/tutorial_certify.md:elbow",
        "Gap of q_dot along q_dot",
        "What damping leaves: a gap that is a straight line in the velocity.",
    ),
    Entry(
        "bounce-jump",
        BOUNCE,
        "Certified bound γ of velocity",
        "A ball above a floor: the bound is large where a step may meet the floor, and only there.",
    ),
    Entry(
        "free-fall-scores",
        "specs/free_fall.yaml",
        "Scores of the held windows",
        "Measured tosses of a cube, no simulator: the scores of those that the fit has not seen; one of them sets the band.",
    ),
    Entry(
        "pendulum-drag",
        "specs/diagnose/pendulum.yaml",
        "Quadratic drag and viscous friction at theta, against theta_dot",
        "What a log asks for at the hinge, without any law, and the two laws that were named.",
        "Why is it wrong?",
    ),
    Entry(
        "tutorial-stage",
        "docs/tutorial_log.md:stage",
        "Coulomb friction at q, against q_dot",
        "A stage on its rail: the jump at rest is dry friction, found in a log with noise.",
    ),
    Entry(
        "linear-drive-law",
        "specs/diagnose/linear_drive.yaml",
        "Asymmetric viscous friction and Coulomb friction at q, against q_dot",
        "The friction of a real ball-screw drive: a jump at rest, and slopes that differ with the direction.",
    ),
    Entry(
        "arm-elbow",
        "specs/diagnose/arm.yaml",
        "elbow on held-out data",
        "An arm's robot file, simulated from the same start, before and after its dry friction was found.",
    ),
    Entry(
        "arm-waterfall",
        "specs/diagnose/arm.yaml",
        "What each cause explained",
        "From the error before to what is left, cause by cause.",
    ),
    Entry(
        "cube-toss",
        "specs/diagnose/cube_toss.yaml",
        "z on held-out data",
        "A real toss that no fit has seen, beside MuJoCo with a friction of 1, and of 0.18.",
    ),
    Entry(
        "compare-matrix",
        "specs/compare.yaml",
        "Simulator against simulator",
        "One pendulum in four engines: all agree to the last bits, but PyBullet as it comes. Above the diagonal the largest "
        "difference after a step, below it the mean, as shares of what the step moves.",
        "Which simulator?",
    ),
    Entry(
        "compare-drift",
        "specs/compare.yaml",
        "How runs come apart",
        "From common starts, under common inputs: who agrees drifts by rounding, who differs at once.",
    ),
    Entry(
        "mecanum-start",
        MECANUM,
        "How long it takes",
        "A mecanum base in a room: in how many commands it is sure to be at its goal, from each place where it may start.",
        "What may a controller promise?",
    ),
    Entry(
        "mecanum-runs",
        MECANUM,
        "Runs on their way",
        "Its runs in MuJoCo from the circles on, with γ and without: who trusts the textbook touches walls, at the crosses.",
    ),
    Entry(
        "courier-runs",
        "specs/courier.yaml",
        "Runs on their way",
        "To and fro round a wall, for ever: a goal that is a formula. At the cross a run that does not know γ leaves it.",
    ),
    Entry(
        "mpc-tube",
        "specs/pendulum_mpc.yaml",
        "omega as it is foreseen",
        "At four moments of a run, the tube in which the controller promises to stay, here thin as a line, and where it went.",
    ),
    Entry(
        "mpc-step",
        "specs/pendulum_mpc.yaml",
        "omega one step ahead",
        "The same, one step ahead, at every step: the promise is as wide as γ, and no wider.",
    ),
)  # fmt: skip


def run(entry: Entry, runs: Path) -> Path:
    """The report of a finished run of the spec, which is run if there is none."""
    name = re.search(r"^name: (\S+)", (ROOT / entry.source).read_text(), re.MULTILINE)
    assert name is not None, f"{entry.spec} has no name"
    pattern = f"{entry.spec.partition(':')[2] or name[1]}-[0-9a-f]*/report.html"
    if not any(runs.glob(pattern)) and entry.of_a_page:
        play(ROOT / entry.source, runs)
    elif not any(runs.glob(pattern)):
        command = [*entry.command.split()[1:], "--quiet", "--out", str(runs)]
        subprocess.run([sys.executable, "-m", "gapcert", *command], cwd=ROOT, check=True)
    return max(runs.glob(pattern), key=lambda p: p.stat().st_mtime)


def play(page: Path, runs: Path) -> dict[str, Any]:
    """Do what a page says, in a folder of its own; what it prints is for tests to judge. Returns the names of its Python."""
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for here in ("specs", "tests"):
            Path(here).symlink_to(ROOT / here)
        for block in blocks.blocks(page):
            if block.caption:
                Path(block.caption).write_text(block.text)
            elif block.language == "python":
                exec(compile(block.text, page.name, "exec"), names)
            for command in re.findall(r"^\$ gapcert ((?:run|diagnose|compare) .*)$", block.text, re.MULTILINE):
                words = shlex.split(command.partition("  #")[0])
                subprocess.run([sys.executable, "-m", "gapcert", *words], check=False)
        for made in Path().glob("runs/*-*"):
            shutil.copytree(made, runs / made.name, dirs_exist_ok=True)
    return names


def brake() -> str:
    """The law of the effect that `tutorial_effect` adds, against what the log asks for."""
    from gapcert_report.pictures.diagnosis import law_picture

    found = play(ROOT / "docs" / "tutorial_effect.md", Path())["found"]
    return drawn(law_picture(0, found.figure.laws[0]))


def backend() -> str:
    """What `write-a-backend` certifies: the gap of an environment along one axis, and γ."""
    from gapcert_report.pictures.svg import TRUTH, WITH, draw

    names = play(ROOT / "docs" / "write-a-backend.md", Path())
    gap, gamma = names["gap"][:, 0], names["certificate"].gamma(*names["at"])[:, 0]

    def paint(ax) -> None:
        ax.fill_between(names["theta"], -gamma, gamma, color=WITH, alpha=0.18, lw=0, label="±γ, certified")
        ax.plot(names["theta"], gap, color=TRUTH, label="the gap, asked afresh")
        ax.set(xlabel="theta [rad], at rest, without torque", ylabel="gap of theta [rad]", xlim=(-1, 1))

    picture = draw("backend", "The gap of theta", "The gap of an environment's angle, inside of what is certified.", paint)
    return drawn(picture)


def envelope() -> str:
    """The theorem in one dimension: samples, their cones, the envelope, and the truth inside."""
    import numpy as np

    from gapcert_report.pictures.svg import FAINT, TRUTH, WITH, draw

    def truth(z: np.ndarray) -> np.ndarray:
        return 0.6 * np.sin(2.2 * z) + 0.15 * np.sin(6 * z)

    slope, z = 2.3, np.linspace(-1.5, 1.5, 601)  # |truth′| ≤ 1.32 + 0.9
    data = np.array([-1.35, -0.8, -0.45, 0.1, 0.5, 1.25])
    cones = slope * np.abs(z[:, None] - data)
    upper, lower = (truth(data) + cones).min(axis=1), (truth(data) - cones).max(axis=1)
    assert ((lower <= truth(z)) & (truth(z) <= upper)).all()

    def paint(ax) -> None:
        ax.fill_between(z, lower, upper, color=WITH, alpha=0.18, lw=0)
        ax.plot(z, upper, color=WITH, label="u: the least cone above")
        ax.plot(z, lower, color=WITH, ls="--", label="l: the greatest below")
        ax.plot(z, truth(z), color=TRUTH, label="r, wherever it may run")
        k = 3
        ax.plot(z, truth(data[k]) + cones[:, k], color=FAINT, lw=0.8, label="the cones of one sample")
        ax.plot(z, truth(data[k]) - cones[:, k], color=FAINT, lw=0.8)
        ax.plot(data, truth(data), "o", color=TRUTH, ms=4)
        ax.set(xlabel="z", ylabel="residual", xlim=(-1.5, 1.5), ylim=(-1.4, 1.6))

    picture = draw(
        "envelope", "The envelope", "Six samples of a residual, and what they and one constant prove of it everywhere.", paint
    )
    return drawn(picture)


DRAWN: dict[str, Callable[[], str]] = {"envelope": envelope, "tutorial-brake": brake, "backend-gap": backend}


def markdown() -> str:
    """The gallery: each picture with its spec, its command and what to see."""
    lines = []
    for entry in ENTRIES:
        lines += [f"## {entry.heading}", ""] if entry.heading else []
        how = f"{{doc}}`{Path(entry.source).stem}`" if entry.of_a_page else f"`{entry.command}`"
        lines += [f"![{entry.see}](images/gallery/{entry.name}.svg)", "", f"{entry.see} {how}", ""]
    shots = sorted(IMAGES.glob("rerun-*.png"))
    lines += ["## In the Rerun viewer", ""] if shots else []
    for shot in shots:
        words = shot.stem.removeprefix("rerun-").replace("-", " ")
        lines += [f"![The recording of a run in the Rerun viewer: {words}](images/{shot.name})", "", f"Rerun: {words}.", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="pictures to make; default: all")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "gallery", help="where run folders are and go")
    chosen = parser.parse_args()
    (IMAGES / "gallery").mkdir(parents=True, exist_ok=True)
    made = {e.name: e for e in ENTRIES}
    for name in chosen.names or (*made, *DRAWN):
        text = DRAWN[name]() if name in DRAWN else cut(run(made[name], chosen.runs).read_text(), made[name].title)
        path = IMAGES / "gallery" / f"{name}.svg"
        path.write_text(text)
        print(f"{path.relative_to(ROOT)}  {len(text.encode()) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
