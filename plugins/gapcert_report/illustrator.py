"""From events to figures: what observers draw, made once per run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, final

from gapcert.plugin import Emit, Event, Pulse
from gapcert_figures import (
    Figures,
    Lane,
    channel_playback,
    drawn,
    gap_figure,
    loop_figure,
    loop_playback,
    recorded_figure,
    winning_figure,
)

from .words.summary import markdown
from .words.words import refutation


@final
class Illustrator:
    """An Emit that adds `figure`, `markdown` (what was found, as text), `refuted` (was it?), `number` and `lanes` to events.

    Every event is passed on; all figures end up in the run folder. A picture may not cost a certificate: one that cannot be
    drawn becomes a warning.
    """

    def __init__(self, folder: Path, emit: Emit) -> None:
        self.folder, self.emit = folder, emit
        self.figures = Figures()
        self._context: dict[str, Any] = {}
        self._count = 0
        self._pulse = Pulse(emit, "pictures", unit="states")
        self._diagnosed: Any = None

    def __call__(self, event: Event) -> None:
        if event.name == "progress":
            return self.emit(event)
        data = dict(event.data) | self._lane(event)
        if event.name == "stage-finished":
            kept = ("model", "with_gamma", "without_gamma")
            self._context |= {k: v for k, v in data.items() if k in kept}
            figure = self._tried("picture", event.stage, lambda: self._draw(event.stage, data))
            if figure is not None:
                data["figure"] = figure
            if event.stage == "certificate":
                found = data["certificate"].summary()
                data |= {"markdown": markdown({"certificate": found}), "refuted": refutation(found) is not None}
        if event.name == "run-finished":
            data["figures"] = self.figures
            data["markdown"] = markdown(data["summary"])
            self.figures.save(self.folder)
        return self.emit(Event(event.name, event.stage, data))

    def _draw(self, stage: str, data: Mapping[str, Any]) -> Any:
        """The figure of a stage, which is kept among the others; None where there is none."""
        drawn = self._drawn(stage, data)
        self.figures = replace(self.figures, **drawn)
        return next(iter(drawn.values()), None)

    def _drawn(self, stage: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if stage == "certificate" and "recording" in data:
            return {"recorded": recorded_figure(data["certificate"])}
        if stage == "certificate" and "backend" in data:  # else γ is declared, and there is nothing beside it to draw
            from gapcert.plugin import Residual

            return {"gap": gap_figure(data["certificate"], Residual(data["backend"], data["model"]), data["domain"])}
        if stage == "controller" and data.get("without_gamma") is not None:
            return {"winning": winning_figure(data["with_gamma"], data["without_gamma"], tell=self._tell)}
        if stage == "recertified" and len(data["controllers"]) == 2:
            both, labels = data["controllers"], ("with the causes", "without the causes")
            return {"winning": winning_figure(both["after"], both["before"], labels, self._tell)}
        if stage == "closed_loop":
            context = (self._context[k] for k in ("model", "with_gamma", "without_gamma"))
            loop, played = loop_figure(data["closed_loop"], *context), data["closed_loop"]
            first, body = int(drawn(played)[0]), data.get("backend")
            if body is not None:
                moving = self._tried("playback", stage, lambda: loop_playback(played, body, first))
                loop = replace(loop, playback=moving)
            return {"loop": loop}
        if stage == "pairs" and data["comparison"].figure.pairs:
            return {"compare": data["comparison"].figure}
        if stage == "diagnosis" and data["diagnosis"].figure is not None and data["diagnosis"].figure is not self._diagnosed:
            found = self._diagnosed = data["diagnosis"].figure
            if found.playback is None:
                bodies = data.get("bodies", ())
                moving = self._tried("playback", stage, lambda: channel_playback(found.channels, bodies))
                found = replace(found, playback=moving)
            return {"diagnosis": found}
        return {}

    def _tell(self, done: int, total: int) -> None:
        self._pulse(done, text="winning domain", total=total)

    def _tried(self, what: str, stage: str, make: Callable[[], Any]) -> Any:
        """What a stage has to show; whatever that stumbles on, the run goes on without it."""
        try:
            return make()
        except Exception as error:  # of an engine, a solver, a plugin
            self(Event("warning", stage, {"message": f"no {what} of {stage}: {type(error).__name__}: {error}"}))
            return None

    def _lane(self, event: Event) -> dict[str, Any]:
        """Number of the event, and all lanes up to it. A stage that ends ends the stages that it began."""
        self._count += 1
        if event.name != "warning":
            state = "running" if event.name.endswith("started") else outcome(event.stage, event.data)
            lanes = {lane.stage: lane for lane in self.figures.lanes}
            begun = lanes[event.stage].at[-1] if event.stage in lanes else self._count
            if event.name.endswith("finished"):
                inner = [lane for lane in lanes.values() if lane.states[-1] == "running" and lane.at[-1] > begun]
                lanes |= {lane.stage: lane.then(self._count, "done") for lane in inner}
            lanes[event.stage] = lanes.get(event.stage, Lane(event.stage, (), ())).then(self._count, state)
            self.figures = replace(self.figures, lanes=tuple(lanes.values()))
        return {"number": self._count, "lanes": self.figures.lanes}


def outcome(stage: str, data: Mapping[str, Any]) -> str:
    """What a finished stage found, in a word or two."""
    if stage == "run":
        return str(data.get("summary", {}).get("verdict", "finished"))
    if stage == "certificate":
        audit = data["certificate"].summary().get("audit", {})
        over = audit.get("violations", 0) > audit.get("allowed", 0)
        return f"{audit['violations']} violations" if over else "holds" if audit else "claimed"
    if stage == "closed_loop":
        summary = data["closed_loop"].summary()
        return "holds" if summary["with_gamma"]["violations"] == 0 else f"{summary['with_gamma']['violations']} violations"
    if stage == "diagnosis":
        return str(data["diagnosis"].summary()["verdict"])
    return "done"
