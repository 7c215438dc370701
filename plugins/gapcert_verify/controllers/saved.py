"""The controller in a run's folder: what it is, what its spec asks of it, and whether its promise can be proved once more."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast, final

import numpy as np

from gapcert.plugin import (
    DAMAGE,
    Box,
    Emit,
    Goal,
    Pulse,
    Relation,
    StateSpec,
    UsageError,
    Zone,
    __version__,
    write_atomic,
)
from gapcert_cells import GROWTH, SEEN, AutomatonController, GridController, saved_data
from gapcert_verify.arithmetic import Range
from gapcert_verify.evaluator import Equations, NotText, quantity
from gapcert_verify.evidence import Evidence

from .asked import Asked
from .cells import BEYOND, Cells
from .games import figures, parts
from .gap_bounds import Gap, coordinates
from .grid_proof import Proof
from .plans import Plans
from .successors import Flow, Growth

PAUSE = 2.0  # seconds between two notes of how far a proof is
Check = tuple[str, Callable[[Evidence], str | None]]


@final
@dataclass(frozen=True)
class Saved:
    """A saved controller beside the certificate and the spec of its run; emit takes the progress of a long proof."""

    evidence: Evidence
    folder: Path
    data: Mapping[str, Any]
    emit: Emit

    @property
    def checks(self) -> list[Check]:
        """What is checked of it, in order."""
        found: list[Check] = [("the controller is of this certificate", lambda e: self._certified())]
        if self.on_cells or self.planned:
            found.append(("the controller and its goal are written as they are read", _said(self._read)))
        if self.on_cells:
            return [
                *found,
                ("goal, cells and inputs of the controller are those of the spec", _said(self._asked)),
                ("every input that the controller allows keeps its promise", _said(self._proved)),
            ]
        if not self.planned:
            return found
        return [
            *found,
            ("goal and horizon of the controller are those of the spec", _said(self._horizon)),
            ("plans are made in the box of the goal and of the inputs", _said(lambda: self._plan(Plans.framed))),
            ("the tube counts at least the gap over X × U", _said(lambda: self._plan(Plans.covered))),
            ("sections of the tube are kept by its gain", _said(lambda: self._plan(Plans.sections))),
            ("where plans end is kept", _said(self._ends)),
        ]

    @property
    def trusted(self) -> list[str]:
        """What its promise rests on beside the checks, by name."""
        kind = self.data.get("kind")
        if self.planned:
            return self._of_plans
        if not self.on_cells:
            return [f"The controller is of kind '{kind}', in a form that is not known here: its promise was not proved again."]
        said = "How many rounds its games took, on which levels, over what its gap was bounded, and why nothing wins"
        out = [
            f"{said}, are as the controller states.",
            "The controller without γ promises nothing of f̂: it was not looked at.",
        ]
        with suppress(UsageError, *DAMAGE):  # of what cannot be read, the checks say so
            out += self._taken
        return out

    @property
    def _taken(self) -> list[str]:
        """What is not text, or not there, and what a person declares."""
        out, asked = list[str](), self._asked_for
        if isinstance(self._flow, str):
            what = (
                "was not proved again" if self.controller.successors is None else "is proved from the successors it has stored"
            )
            out.append(f"The controller's promise {what}: {self._flow} was not bounded.")
        elif self._flow.growth is not None:
            given = self._section["growth"]["model"]
            told = "; ".join(f"{n}: {t}" for n, t in self._growth_section.get("next", {}).items()) or "integrated"
            out.append(f"Successors of cells spread as the growth bound {given} declares ({told}).")
        if isinstance(asked, str):
            out.append(f"Goal, cells and inputs of the controller are those that were asked for: of a spec, {asked}.")
        elif asked.cuts:
            out.append("The inequalities of the goal's polytopes do what their texts say.")
        return out

    @cached_property
    def on_cells(self) -> bool:
        """Is it one of those that `gapcert_cells` saves, whoever made it?"""
        with suppress(*DAMAGE), np.load(self.folder / "controller.npz", allow_pickle=False) as arrays:
            return "bits" in arrays.files
        return False

    @cached_property
    def planned(self) -> bool:
        """Is it one that plans, along lines that are stored?"""
        return self.data.get("kind") == "mpc" and "frame.middle" in self.arrays and not {"adapt", "feedback"} & set(self.data)

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Of `controller.npz`; none where it cannot be read."""
        with suppress(*DAMAGE), np.load(self.folder / "controller.npz", allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
        return {}

    @property
    def _of_plans(self) -> list[str]:
        out = [
            "What solvers answer is checked as a run goes on: plans, corridors, how solvers were tuned, and the figures of the "
            "reference, the tube, its end and the domain are as stated.",
            "The controller without γ promises nothing of f̂: it was not looked at.",
        ]
        with suppress(UsageError, *DAMAGE):
            if isinstance(self._flow, str):
                out.append(f"What the tube counts, and where plans end, is as stated: {self._flow} was not bounded.")
            if bool(self.arrays["successive"]):
                out.append(
                    "Lines about plans, and what they leave out, are made as a run goes on, of the model and the gap beside it."
                )
            if isinstance(asked := self._asked_for, str):
                out.append(f"The controller's goal is that which was asked for: of a spec, {asked}.")
        return out

    @cached_property
    def loaded(self) -> GridController | AutomatonController:
        """Its digest is checked while it is read."""
        return (AutomatonController if "automaton" in self.data["goal"] else GridController).load(self.folder)

    @property
    def controller(self) -> GridController:
        """Its cells, and what is promised of them."""
        return self.loaded.parts[0] if isinstance(self.loaded, AutomatonController) else self.loaded

    @cached_property
    def stored(self) -> dict[str, Any]:
        """The run's spec as it is stored; empty where there is none."""
        with suppress(OSError, ValueError):
            found = json.loads((self.evidence.folder / "spec.json").read_text(encoding="utf-8"))
            return found if isinstance(found, dict) else {}
        return {}

    @cached_property
    def home(self) -> Path:
        """Where the spec's paths start."""
        with suppress(OSError, ValueError):
            return Path(json.loads((self.evidence.folder / "run.json").read_text(encoding="utf-8"))["folder"])
        return Path()

    @property
    def _section(self) -> Mapping[str, Any]:
        return cast("Mapping[str, Any]", self.stored.get("controller") or {})

    @cached_property
    def _asked_for(self) -> Asked | str:
        """What the spec asks of it; or why that is not known."""
        zone, axes = self.evidence.zone, tuple(StateSpec(*a) for a in self.data["goal"]["axes"])
        if not self._section:
            return "there is none"
        asked = Asked(self.stored, Box(axes, zone.low[: len(axes)], zone.high[: len(axes)]), self.home)
        try:
            _ = asked.goal
        except OSError as error:
            return f"{error.filename}: {error.strerror}"
        except KeyError as error:
            return f"the spec's goal has no {error}"
        return asked

    @cached_property
    def _model(self) -> Equations | str:
        """The equations of the run; or why not."""
        section, names = self.stored.get("model"), [a[0] for a in self.data["goal"]["axes"]]
        if not isinstance(section, dict):
            return "its model, which no spec beside it states,"
        try:
            made = Equations.of(section)
            added = [n for n in names if n not in made.states]
            return Equations.of(section, added) if added else made
        except NotText as error:
            return str(error)

    @cached_property
    def _growth_section(self) -> Mapping[str, Any]:
        return self._elsewhere(self._section["growth"]["model"])

    def _elsewhere(self, path: str) -> Mapping[str, Any]:
        """The model of another spec."""
        from ruamel.yaml import YAML

        try:
            found = YAML(typ="safe", pure=True).load((self.home / path).read_text(encoding="utf-8"))
        except OSError as error:
            raise NotText(f"{path}, which cannot be read ({error.strerror}),") from None
        if not isinstance(found, dict) or not isinstance(found.get("model"), dict):
            raise NotText(f"{path}, which states no model itself,")
        return cast("Mapping[str, Any]", found["model"])

    @cached_property
    def _flow(self) -> Flow | str:
        model, points = self._model, np.empty((0, 0))
        if self.on_cells:
            points = np.asarray(self.controller.points, dtype=np.float64)
        if isinstance(model, str):
            return model
        growth: Growth | None = None
        try:
            if self._section.get("growth"):
                error = np.zeros(model.nx)
                for name, value in (self._section.get("error") or {}).items():
                    error[model.states.index(name)] = quantity(value)[1]
                growth = Growth(Equations.of(self._growth_section), error)
            extended = self._extended()
        except NotText as error_:
            return str(error_)
        relative = coordinates(model, self.stored.get("coordinates"))
        return Flow(model, Gap(self.evidence, relative, extended, model), growth, points)

    def _extended(self) -> Equations | None:
        """The model that the certificate's predictor is the step of, less that of the run's model."""
        if self.evidence.data["predictor"] != "model":
            return None
        return Equations.of(self._elsewhere(self.stored["gap"]["predictor"]["model"]))

    def _certified(self) -> str:
        """It names this certificate as the one behind its promise."""
        named = self.data["evidence"].get("certificate")
        own = hashlib.sha256((self.evidence.folder / "certificate.json").read_bytes()).hexdigest()
        if named == own:
            return ""
        found = f"rests on certificate {named[:16]}…" if named else "names no certificate"
        return f"the saved controller {found}, and this one is {own[:16]}…; run the spec again"

    def _read(self) -> str:
        own = "held" if self.on_cells else "solver kept terminal adapt feedback"
        if extra := sorted(self.data.keys() - set(f"digest evidence format goal kind {own}".split())):
            return f"it has an unknown field {extra[0]!r}"
        stated = self.data["goal"]
        made = json.loads(json.dumps(Goal.from_data(stated).to_data()))
        return "" if stated == made else f"the goal is stated as {stated}, and read as {made}"

    def _asked(self) -> str | None:
        """Goal, cells and inputs are those of the spec, the names and the box of states those of the certificate."""
        c, e = self.controller, self.evidence
        goal, nx = c.goal, e.data["domain"]["states"]
        axes = e.data["domain"]["axes"]
        if list(goal.stay.names) != axes[:nx]:
            return f"its states are {', '.join(goal.stay.names)}, and the certificate's {', '.join(map(str, axes[:nx]))}"
        model = self._model
        if isinstance(model, Equations):
            if list(goal.stay.names) != list(model.states) or [a.kind == "angle" for a in goal.stay.axes] != list(model.angles):
                return f"its states are {list(goal.stay.axes)}, and the model's {', '.join(model.states)}"
            if not self.stored.get("coordinates") and list(model.inputs) != axes[nx:]:
                return (
                    f"the model's inputs are {', '.join(model.inputs)}, and the certificate's {', '.join(map(str, axes[nx:]))}"
                )
        if any(
            a < low or b > high for a, b, low, high in zip(goal.stay.low, goal.stay.high, e.zone.low, e.zone.high, strict=False)
        ):
            return "its goal reaches beyond the domain of the certificate"
        if text := self._evidence():
            return text
        asked = self._asked_for
        return None if isinstance(asked, str) else asked.differs(self.controller, str(self.data.get("kind")))

    def _evidence(self) -> str:
        """What `evidence` says of cells is so, and what it rests on is named."""
        c, said = self.controller, self.data["evidence"]
        found: dict[str, Any] = {**figures(Cells.of(c), self.loaded), "inputs": len(c.points)}
        if self.loaded.goal.automaton is not None:
            found["automaton_states"] = len(self.loaded.goal.automaton.after)
        if c.held is not None:
            found["held"] = c.held.bounds
        for name, value in found.items():
            if said.get(name) != value and not (isinstance(value, float) and abs(said.get(name, 2.0) - value) < 1e-12):
                return f"{name} is {value}, and stated as {said.get(name)}"
        allowed = ([GROWTH], [GROWTH, SEEN]) if self._section.get("growth") else ([],)
        if self._section.get("kind") == "symbolic" and said.get("assumptions", []) not in allowed:
            return f"it rests on {allowed[0] or 'no assumption'}, and states {said.get('assumptions')}"
        return ""

    def _proved(self) -> str | None:
        flow, c = self._flow, self.controller
        if isinstance(flow, str):
            return None if c.successors is None else self._run(None)
        zone = self.evidence.zone
        u = np.asarray(c.points)
        nx = len(c.goal.stay.axes)
        inside = ((u >= zone.low[nx:]) & (u <= zone.high[nx:])).all()
        if (flow.gap is None or flow.gap.relative is None) and not inside:
            return f"inputs from {u.min(axis=0).tolist()} to {u.max(axis=0).tolist()} are beyond the certificate's domain"
        return self._run(flow)

    @property
    def _zone(self) -> Zone:
        """The certificate's domain over (x, u), with ranges of relative inputs as relations."""
        zone, flow = self.evidence.zone, self._flow
        if not isinstance(flow, Flow) or flow.gap is None or (relative := flow.gap.relative) is None:
            return zone
        c, d, nx = relative.slope, relative.scale, relative.slope.shape[1]
        names, w = self.evidence.data["domain"]["axes"][nx:], np.eye(len(zone.low))[nx:]
        rows = [(r.text, a, r.bound) for r, a in zip(zone.relations, zone.matrix, strict=True)]
        rows += [(f"{n} <= {b:g}", a, b) for n, a, b in zip(names, w, zone.high[nx:], strict=True)]
        rows += [(f"{n} >= {b:g}", -a, -b) for n, a, b in zip(names, w, zone.low[nx:], strict=True)]
        moved = (Relation(t, (*(a[:nx] + a[nx:] @ c).tolist(), *(a[nx:] * d).tolist()), b) for t, a, b in rows)
        ranges = [self.stored["domain"][n] for n in flow.model.inputs]
        low, high = ([quantity(given[k])[k] for given in ranges] for k in (0, 1))
        return Zone((*zone.low[:nx], *low), (*zone.high[:nx], *high), tuple(moved))

    def _horizon(self) -> str | None:
        asked = self._asked_for
        if isinstance(asked, str):
            return None
        steps = len(self.arrays["stages.A"]) - 1
        if steps != self._section.get("horizon", 20):
            return f"it plans {steps} steps, and the spec asks for {self._section.get('horizon', 20)}"
        if (stated := self.data["evidence"].get("horizon", steps)) != steps:
            return f"it plans {steps} steps, and {stated} are stated"
        return asked.another(Goal.from_data(self.data["goal"]), "mpc")

    def _plan(self, check: Callable[[Plans], str | None]) -> str | None:
        flow = self._flow
        if isinstance(flow, str) or flow.gap is None:
            return None
        return check(Plans(self.arrays, Goal.from_data(self.data["goal"]).stay, self._zone, flow.model, flow.gap))

    def _ends(self) -> str | None:
        """Around a steady pair; or in cells that win, of a controller that is proved as any other on cells is."""
        if "terminal" not in self.data:
            return self._plan(Plans.terminal)
        folder = self.folder / "terminal"
        then = replace(self, folder=folder, data=saved_data(folder))
        if (
            not then.on_cells
            or isinstance(then.loaded, AutomatonController)
            or then.loaded.goal != Goal.from_data(self.data["goal"])
        ):
            return "what takes over from its plans is no controller on cells for the same goal"
        if text := then._proved():
            return f"what takes over from its plans: {text}"
        return self._plan(lambda plans: _losing(Cells.of(then.controller), plans.ends()))

    def _run(self, flow: Flow | None) -> str:
        cells = Cells.of(self.controller)
        found = parts(cells, self.loaded)
        if isinstance(found, str):
            return found
        kept, pulse = _Kept.of(self), Pulse(self.emit, "controller", cells.size, "cells", "proof")

        def tick(done: int, total: int) -> None:
            kept.done(done, total)
            pulse(done)

        return Proof(cells, found, flow, self._zone, tick, kept.begin).run()


def _losing(cells: Cells, boxes: Sequence[Box]) -> str:
    """Boxes in which plans end lie in cells that win; none may be there where they end so."""
    values = np.asarray(cells.controller.values, dtype=np.int64)
    (height,) = cells.heights(np.where(values < 0, BEYOND, 0).astype(np.int32)) if len(cells.levels) == 1 else (None,)
    if height is None:
        return "what takes over from its plans has halved cells"
    (level,) = cells.levels
    for box in boxes:
        ends = [a.touched(Range(np.array([x]), np.array([y]))) for a, x, y in zip(level.axes, box.low, box.high, strict=True)]
        if height.over(*(np.stack(end, axis=1) for end in zip(*ends, strict=True)))[0]:
            return f"the box {box.bounds} in which plans end touches losing cells"
    return "" if boxes else "plans end in no box"


def _said(check: Callable[[], str | None]) -> Callable[[Evidence], str | None]:
    """What a file that cannot be used says is what is wrong."""

    def told(e: Evidence) -> str | None:
        try:
            return check()
        except UsageError as error:
            return str(error)

    return told


def controlled(e: Evidence, emit: Emit) -> Saved | None:
    """The controller of a run that knows γ; None where there is none."""
    places = e.folder / "controller" / "with_gamma", e.folder / "controller"
    folder = next((p for p in places if (p / "controller.json").is_file()), None)
    if folder is None:
        return None
    data: Mapping[str, Any] = {}
    with suppress(UsageError):  # the checks say what is missing
        data = saved_data(folder)
    return Saved(e, folder, data, emit)


@final
class _Kept:
    """How far a proof has come, in the user's own cache: a folder of somebody else's says nothing that would be believed."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.begin, self._last = path, 0, time.monotonic()
        if path is not None:
            with suppress(OSError, ValueError):
                if path.stat().st_uid == os.geteuid():
                    self.begin = int(path.read_text())

    @classmethod
    def of(cls, saved: Saved) -> _Kept:
        """Of everything that the proof is about, and of the code that does it."""
        total = hashlib.sha256(__version__.encode())
        run, own = saved.evidence.folder, Path(__file__).parent
        files = [run / n for n in ("certificate.json", "certificate.npz", "spec.json", "run.json")]
        files += [saved.folder / "controller.json", saved.folder / "controller.npz"]
        files += sorted(own.glob("*.py")) + sorted(own.parent.glob("*.py"))
        if saved._section.get("growth"):
            files.append(saved.home / saved._section["growth"]["model"])
        for path in files:
            total.update(hashlib.sha256(path.read_bytes() if path.is_file() else b"").digest())
        try:
            home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gapcert" / "verify"
        except RuntimeError:
            return cls(None)  # nobody's home: nothing is kept
        return cls(home / total.hexdigest())

    def done(self, count: int, total: int) -> None:
        """Keep it, at most every other second; what is finished is forgotten."""
        if self.path is None or (time.monotonic() - self._last < PAUSE and count < total):
            return
        self._last, home = time.monotonic(), self.path.parent
        with suppress(OSError):
            if count == total:
                self.path.unlink(missing_ok=True)
                return
            home.mkdir(mode=0o700, parents=True, exist_ok=True)
            if home.stat().st_uid == os.geteuid():
                write_atomic(self.path, str(count).encode(), flush=False)
