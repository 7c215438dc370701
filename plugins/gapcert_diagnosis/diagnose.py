"""diagnose(): why is a model wrong? A recording in; causes with evidence, rivals, and what they buy on held-out data out."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import BEAT, Effect, Emit, Event, Model, Recording, UsageError, silent
from gapcert_engines import NativeModel
from gapcert_recordings import JITTER, repairs

from .data import time_units as clocks
from .data.dataset import FEWEST as SHORTEST
from .data.dataset import Dataset
from .data.joint_limits import kept_within
from .experiment.design import Limits, told_apart
from .figure import figure
from .fitting.fit import Fit, fit
from .fitting.rollout_error import Stretches, stretches
from .fitting.step_size import coarse
from .native.driver import diagnose_native
from .residual import unexplained as leftover
from .residual.tests import evidence
from .results import Cause, Diagnosis, Estimate, Experiment, Gain, Misfit, Rival, Verdict
from .search.alternatives import Answer, answered, flags, smallest
from .search.candidates import Candidate, Causes, Library
from .search.criterion import TIE, keys, values
from .search.engine_settings import Setting, across

WINDOW, COUPLED = 1.2, 0.8  # s, with one coordinate and with several
ENOUGH = 16_000  # measured values that are fitted
GUARDED = 4  # windows at least: those that judge what the others suggest are among them
LEAST, FEWEST = 30, 8  # samples in a window; windows


def diagnose(
    model: Model,
    recording: Recording,
    effects: Sequence[Effect | str] | Literal["all"] = "all",
    *,
    hold_out: Mapping[str, Any] | None = None,
    train: Mapping[str, Any] | None = None,
    horizons: Sequence[float] = (0.5,),
    window: float | None = None,
    experiment: Mapping[str, Any] | None = None,
    seed: int = 0,
    emit: Emit = silent,
    folder: Path | None = None,
) -> Diagnosis:
    """The causes of the difference between a model and a recording.

    Dataset outputs are compared with simulated ones over windows whose start is free. A cause is named when its fall in score
    pays for its parameters and for the number of rivals, and when a later stretch of the data agrees. The gain is measured by
    free rollouts over `hold_out` (default: the last quarter), which no fit has seen, at the given horizons in s. experiment:
    what an experiment may do that tells apart what these data do not: `limits` of inputs and outputs, `seconds`. train: the
    trajectories that are fitted. An engine in contact is rolled out itself; folder: keeps that for an interrupted search.
    """
    clock = _Clock(emit)
    _timed(model, recording, horizons)
    fitting, held_out = recording.split(hold_out or {"last": 0.25}, train)
    chosen = _effects(effects)
    if isinstance(model, NativeModel):
        given = (fitting, held_out), {e.name for e in chosen}, horizons, window, seed, emit, folder, clock.lap
        return replace(diagnose_native(model, *given), timings=clock.laps)
    library = Library(model, Dataset.of(model, fitting), chosen)
    measured = library.measured
    held = _held(model, measured, *recording.led_up(held_out))
    _warned(emit, measured, held)
    assumed = kept_within(model, measured, held)
    windows = measured.windows(_length(measured, model, window)).thinned(ENOUGH, GUARDED)
    stretches(held, horizons)  # refuses before the search is paid for
    clock.lap("evidence")

    settled = across(library, chosen, windows, clock.tell)
    clock.lap("search")

    answer, measured = answered(settled.search, settled.found, windows), settled.search.windows.measured
    if settled.settings:
        answer = replace(answer, plain=fit(library.hypothesis(()), answer.search.windows))
    judges = stretches(replace(held, hold=measured.hold), horizons, measured, answer.fit)
    named = _causes(answer := _largest_first(answer, judges[-1]), settled.settings, judges[-1])
    clock.lap("rivals")

    gain = {f"{j.horizon:g}": j.gains(answer.nothing, answer.fit, seed) for j in judges}
    clock.lap("gain")
    limits = _limits(library.model, measured, experiment or {})
    design = told_apart(answer.causes, answer.fit, answer.ties, measured, limits, seed)[0]
    clock.lap("experiment")
    left = leftover.left(library.extended(answer.causes, values(answer.fit)), answer.fit, answer.search.windows, seed)
    doubt = clocks.doubt(answer.fit, answer.search.windows)
    verdict = leftover.verdict(len(named), left, answer.fit, answer.nothing, design is not None, bool(doubt))
    named = tuple(replace(c, flags=(*c.flags, *leftover.doubts(len(named), left))) for c in named)
    clock.lap("leftover")
    told = _told(verdict, named, answer, gain, left, design, judges[-1], settled.settings, clock)
    return replace(told, assumptions=(*assumed, *doubt), seconds=_tried(answer, limits, design))


def _tried(answer: Answer, limits: Limits, design: Experiment | None) -> float | None:
    """How long the experiments were, of which none tells the ties apart."""
    return limits.seconds if answer.ties and limits.inputs and not design else None


def _limits(model: Model, measured: Dataset, experiment: Mapping[str, Any]) -> Limits:
    return Limits.of(model, measured, experiment.get("limits"), experiment.get("seconds", 12.0))


def _held(model: Model, fitted: Dataset, with_past: Recording, since: tuple[float, ...]) -> Dataset:
    """What is held out, with what was measured before it, in the terms of what is fitted."""
    return replace(Dataset.of(model, with_past), sigma=fitted.sigma, spread=fitted.spread, since=since)


def _warned(emit: Emit, fitted: Dataset, held: Dataset) -> None:
    """What is changed in a log is told, however little else is: once where both parts say the same."""
    parts = ("held out, and of what led up to them", held), ("fitted", fitted)
    said = {"; ".join(repairs(m.log)): where for where, m in parts}
    for text, where in reversed(said.items()):
        if text:
            emit(Event("warning", "recording", {"message": f"of the data that are {where}: {text}"}))


def _largest_first(answer: Answer, judge: Stretches) -> Answer:
    """Causes by the held-out error that each of them missing would leave: the order of finding is the search's own affair."""

    def left(c: Candidate) -> float:
        rest = tuple(k for k in answer.causes if k is not c)
        return judge.error(answer.search.fit(rest, (answer.causes, answer.fit)))

    return replace(answer, causes=tuple(sorted(answer.causes, key=left, reverse=True)))


def _causes(answer: Answer, settings: Sequence[Setting], judge: Stretches) -> tuple[Cause, ...]:
    """Settings, effects, and what shows in the measured values alone."""
    named = tuple(_set(answer, s, judge) for s in settings)
    named += tuple(_named(answer, c, judge) for c in answer.causes)
    return named + tuple(_read(answer, c, numbers, judge) for c, numbers in answer.search.library.seen)


def _told(
    verdict: Verdict,
    named: tuple[Cause, ...],
    answer: Answer,
    gain: Mapping[str, Mapping[str, Gain]],
    left: leftover.Left,
    design: Experiment | None,
    judge: Stretches,
    set_: Sequence[Setting],
    clock: _Clock,
) -> Diagnosis:
    others = [(("engine-setting", s.runner_up.setting),) for s in set_ if s.runner_up and s.margin < TIE]
    rest = leftover.unexplained(left) if verdict == "unexplained" else None
    measured = answer.search.windows.measured
    settings = [c.site for c in named if c.effect == "engine-setting"]
    plain = None if answer.plain is None else (f"setting {' and '.join(settings)}", answer.plain)
    return Diagnosis(
        verdict,
        named,
        _misfits(answer, measured),
        gain,
        _extended(answer),
        (*(tuple(c.key for c in tie) for tie, _ in answer.ties), *others),
        None if design is None else _experiment(answer),
        rest,
        figure(answer.search, answer.causes, answer.fit, judge, design, rest.correction if rest else None, plain),
        clock.laps,
        design=design,
        evidence=evidence(left),
        negligible=tuple((*k, s) for k, s in answer.negligible.items() if k not in keys(answer.causes)),
        smallest=smallest(answer.search) if verdict == "nothing" else (),
        log={**measured.log, "hold": measured.hold or "undeclared"},
        warnings=coarse(answer.fit, answer.search.windows),
        refitted=_refitted(answer),
    )


def _refitted(answer: Answer) -> dict[str, dict[str, Any]]:
    """The stated parameters that have a tolerance, and what the data make of them beside the causes."""
    library, last = answer.search.library, answer.fit
    known, widths = values(last), dict(zip(last.hypothesis.names, map(float, last.interval()), strict=True))
    freed = {library.extension(c).frees for c in answer.causes}
    loose = [p for p in library.model.parameters if p.tolerance > 0 and p.name in known and p.name not in freed]
    return {
        p.name: {
            "stated": p.value,
            "value": known[p.name],
            "low": known[p.name] - widths[p.name],
            "high": known[p.name] + widths[p.name],
            "unit": p.unit,
        }
        for p in loose
    }


@final
class _Clock:
    """Wall time per part, and progress for observers."""

    def __init__(self, emit: Emit) -> None:
        self.emit, self.count, self.last, self.told = emit, 0, time.perf_counter(), 0.0
        self.laps: dict[str, float] = {}
        self.best: Mapping[str, Any] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self.last = round(now - self.last, 3), now

    def tell(self, text: str, best: Mapping[str, Any] | None = None, *, fitted: bool = True) -> None:
        """What is tried next: a hypothesis that is fitted, or one of many that are only screened, of which few are told."""
        now = time.perf_counter()
        self.count += fitted
        if fitted or now - self.told > BEAT:
            self.told = now
            # A search that begins anew, on other windows, has no best of its own yet.
            self.best = best or self.best
            more = {"best": self.best} if self.best else {}
            self.emit(Event("progress", "diagnosis", {"done": self.count, "unit": "hypotheses", "text": text, **more}))


def _effects(effects: Sequence[Effect | str] | Literal["all"]) -> list[Effect]:
    from gapcert.plugin import registry

    known = registry()
    names = known.names("effect") if effects == "all" else effects
    found: list[Effect] = [known.build("effect", e) if isinstance(e, str) else e for e in names]
    if not found:
        raise UsageError("diagnose: no effect is given; name at least one, or `all`")
    return found


def _timed(model: Model, recording: Recording, horizons: Sequence[float]) -> None:
    """Refuses rows in no order, and what is shorter than a sample: as a rule times in another unit than they are read in."""
    clocks.ordered(recording)
    period, shortest = recording.period, min(horizons, default=math.inf)
    if 0 < shortest < (1 - JITTER) * period:
        raise UsageError(
            f"diagnose.horizons: {shortest:g} s is shorter than {period:.6g} s, the period of the recording; expected at least "
            "that; is its time in s? Give the unit of that column otherwise, recording.units: {TIME: ms}, or longer horizons",
            ("diagnose", "horizons"),
        )
    clocks.agreeing(model, recording)


def _length(measured: Dataset, model: Model, window: float | None) -> int:
    lengths = [len(y) - measured.history for y in measured.outputs]
    usual = measured.samples(WINDOW if len(model.coordinates) < 2 else COUPLED)
    if window is None:
        return max(LEAST, min(usual, sum(lengths) // FEWEST, min(lengths)))
    if (own := measured.samples(window)) < SHORTEST:
        raise UsageError(
            f"diagnose.window: {window:g} s hold {own} samples, {measured.period:g} s apart; expected {SHORTEST} or more; give "
            f"{SHORTEST * measured.period:g} s, or leave it out",
            ("diagnose", "window"),
        )
    return own


def _named(answer: Answer, c: Candidate, judge: Stretches) -> Cause:
    """A cause with its numbers, its share, its runner-up, and what speaks against it."""
    library, last = answer.search.library, answer.fit
    rest = tuple(k for k in answer.causes if k is not c)
    before = judge.error(answer.search.fit(rest, (answer.causes, last)))
    runner_up = None
    for rival, fitted in answer.rivals[c.key][:1]:
        other = next(k for k in rival if k.key not in {r.key for r in rest})
        runner_up = Rival(
            *other.key, _share(judge.error(fitted), before), answer.search.better(last, fitted), judge.rms(fitted)
        )
    share = _share(judge.error(last), before)
    native = library.model.native(*c.key)
    return Cause(*c.key, _numbers(library, c, last), share, runner_up, native, flags(library, c, last))


def _set(answer: Answer, s: Setting, judge: Stretches) -> Cause:
    """A setting of the engine: what it explains beside all other causes, refitted without it."""
    h = Library(s.before.model, s.before.measured, []).hypothesis(answer.causes)
    known = dict(zip(h.names, h.value.tolist(), strict=True)) | values(answer.fit)
    before = judge.error(fit(h, answer.search.windows, theta=np.array([known[n] for n in h.names])))
    v, numbers = s.variant, dict[str, Estimate]()
    if isinstance(v.value, int | float) and not isinstance(v.value, bool):
        numbers["value"] = Estimate(float(v.value), "1", float(v.value), float(v.value))
    rival = None
    if s.runner_up is not None:
        other = fit(Library(s.runner_up.model, s.before.measured, []).hypothesis(()), answer.search.windows)
        rival = Rival("engine-setting", s.runner_up.setting, _share(judge.error(other), before), s.margin, judge.rms(other))
    share = _share(judge.error(answer.fit), before)
    changed = {"value": v.value, "was": v.was}
    return Cause("engine-setting", v.setting, numbers, share, rival, v.native, setting=changed)


def _read(answer: Answer, c: Candidate, numbers: Mapping[str, float], judge: Stretches) -> Cause:
    """A cause that shows in the measured values alone: explained is what it makes of the error without taking part in it."""
    library, m = answer.search.library, judge.windows.measured
    channel = [s.name for s in m.channels].index(c.site)
    before = judge.error(answer.fit) ** 2
    # All of the noise floor, where the rounding is most of it.
    left = max(0.0, before - m.sigma[channel] ** 2 / m.spread[channel] ** 2 / len(m.channels))
    known = {
        p.name: Estimate(numbers[n], unit, numbers[n], numbers[n])
        for p, n, unit in zip(c.effect.parameters, library.names(c), library.units(c), strict=True)
    }
    return Cause(*c.key, known, _share(math.sqrt(left), math.sqrt(before)))


def _extended(answer: Answer) -> Model:
    library, numbers = answer.search.library, values(answer.fit)
    for _, found in library.seen:
        numbers |= found
    return library.extended((*answer.causes, *(c for c, _ in library.seen)), numbers)


def _numbers(library: Library, c: Candidate, last: Fit) -> dict[str, Estimate]:
    known, widths = values(last), dict(zip(last.hypothesis.names, map(float, last.interval()), strict=True))
    names = library.names(c)
    shown = c.effect.canonical({p.name: known[n] for p, n in zip(c.effect.parameters, names, strict=True)})
    numbers = {}
    for p, name, unit in zip(c.effect.parameters, names, library.units(c), strict=True):
        value, half = shown[p.name], widths[name]
        numbers[p.name] = Estimate(value, unit, value - half, value + half)
    return numbers


def _share(after: float, before: float) -> float:
    return 1 - after / before if before > 0 else 0.0


def _misfits(answer: Answer, measured: Dataset) -> dict[str, Misfit]:
    old, new = (np.sqrt(f.chi) * measured.sigma for f in (answer.nothing, answer.fit))
    return {c.name: Misfit(float(old[i]), float(new[i]), float(measured.sigma[i])) for i, c in enumerate(measured.channels)}


def _experiment(answer: Answer) -> str | None:
    """What would tell the first tie apart."""
    for tie, _ in answer.ties:
        a, b = _without(answer.causes, tie)[0], _without(tie, answer.causes)[0]
        known = a.effect.rivals.get(b.effect.name) or b.effect.rivals.get(a.effect.name)
        text = known or f"{a.effect.experiment}; {b.effect.experiment}"
        return f"to tell {a.effect.name} at {a.site} from {b.effect.name} at {b.site}: {text}"
    return None


def _without(causes: Causes, others: Causes) -> Causes:
    return tuple(c for c in causes if c.key not in {k.key for k in others})
