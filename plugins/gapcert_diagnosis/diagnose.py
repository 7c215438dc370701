"""diagnose(): why is a model wrong? A recording in; causes with evidence, rivals, and what they buy on held-out data out."""

from __future__ import annotations

import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, final

import numpy as np

from gapcert.plugin import BEAT, Effect, Emit, Event, Model, Recording, UsageError, registry, silent
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_recordings import JITTER, Copies, repairs

from .data.consistency import agreeing, doubt, kept_within, ordered
from .data.dataset import Dataset, Windows
from .data.defaults import last_quarter, usual_horizons
from .data.feedback import loops
from .experiment import Limits, told_apart
from .figure import figure
from .fitting.fit import Fit, fit, followed
from .fitting.rollout_error import Stretches, stretches
from .fitting.step_size import coarse, paced, quickened, settled
from .residual import unexplained as leftover
from .residual.adequacy import blind, close
from .residual.pushes import elsewhere, pushes
from .results import Cause, Diagnosis, Estimate, Misfit, Push, Rival, Verdict
from .search.alternatives import Answer, answered, completed, decided, flags, unit_slip
from .search.candidates import Candidate, Causes, Library
from .search.criterion import noise, without
from .search.engine_settings import Setting, Settled, across
from .search.fitted_sets import FittedSets
from .search.visible import smallest

T = TypeVar("T")
U = TypeVar("U")
PUSH = "external-push"
_MEASURED = {"input": "{} where it acts", "output": "{} with a second sensor", "coordinate": "the force at {}"}


def diagnose(
    model: Model,
    recording: Recording,
    effects: Sequence[Effect | str] | Literal["all"] = "all",
    *,
    hold_out: Mapping[str, Any] | None = None,
    train: Mapping[str, Any] | None = None,
    horizons: Sequence[float] | None = None,
    window: float | None = None,
    experiment: Mapping[str, Any] | None = None,
    seed: int = 0,
    emit: Emit = silent,
    folder: Path | None = None,
    exact: Sequence[str] = (),
) -> Diagnosis:
    """The causes of the difference between a model and a recording.

    Measured outputs are compared with simulated ones over windows whose start is free. A cause is named when its fall in score
    pays for its parameters and for the number of rivals, and when a later stretch of the data agrees. The gain is measured by
    free rollouts over `hold_out` (default: the last quarter), which no fit has seen, at horizons in s (default: of one turn of
    the motion, and of three). experiment: what an experiment may do that tells apart what these data do not: `limits` of inputs
    and outputs, `seconds`. train: the trajectories that are fitted. A model for which there is a `diagnoser`, such as an engine
    in contact, which is rolled out itself, is left to that; folder: keeps what an interrupted search goes on with. exact:
    inputs that act as they are logged, such as gains and enables.
    """
    given = hold_out, train, horizons, window, experiment, seed, emit, folder, exact
    problem, copies = posed(model, recording, effects, *given)
    clock = problem.clock
    other = rolled_out(model)
    found = _searched(problem) if other is None else other.diagnose(problem)
    if not copies.found:
        return replace(found, timings=clock.laps)
    log = {**found.log, "copies": copies.summary()}
    return replace(found, timings=clock.laps, assumptions=(*found.assumptions, copies.told), log=log)


def posed(
    model: Model,
    recording: Recording,
    effects: Sequence[Effect | str] | Literal["all"] = "all",
    hold_out: Mapping[str, Any] | None = None,
    train: Mapping[str, Any] | None = None,
    horizons: Sequence[float] | None = None,
    window: float | None = None,
    experiment: Mapping[str, Any] | None = None,
    seed: int = 0,
    emit: Emit = silent,
    folder: Path | None = None,
    exact: Sequence[str] = (),
) -> tuple[DiagnosisProblem, Copies]:
    """The question that `diagnose` answers, with defaults made; and what is in the recording twice."""
    clock = Clock(emit)
    _timed(model, recording, horizons)
    parts, copies = _once(recording, hold_out or last_quarter(recording), train, [s.name for s in model.inputs])
    horizons = usual_horizons(recording, parts[1], [s.name for s in model.outputs]) if horizons is None else horizons
    if copies.found:
        clock.emit(Event("warning", "recording", {"message": copies.told}))
    more = experiment or {}
    if unknown := [n for n in exact if n not in {s.name for s in model.inputs}]:
        known = ", ".join(s.name for s in model.inputs) or "none"
        what = f"diagnose.exact: '{unknown[0]}' is no input of the model; expected some of its inputs: {known}"
        raise UsageError(what, ("diagnose", "exact"))
    used = _effects(effects)
    return DiagnosisProblem(model, recording, *parts, used, horizons, window, more, seed, folder, clock, exact), copies


def rolled_out(model: Model) -> Diagnoser | None:
    """The diagnoser that answers for a model in place of the search with equations, if there is one."""
    others = (c.load()() for c in registry().of("diagnoser") if c.missing() is None)
    return next((d for d in others if d.accepts(model)), None)


def _once(
    recording: Recording, hold_out: Mapping[str, Any], train: Mapping[str, Any] | None, inputs: Sequence[str]
) -> tuple[tuple[Recording, Recording], Copies]:
    """(what is fitted, what is held out), where what was measured once counts once; and what is in the recording twice.

    Where whole trajectories are held out, it is those that count, and their copies are not fitted.
    """
    whole = train is not None or not set(hold_out) & {"last", "from", "to"}
    copies = None if whole else Copies.of(recording, inputs)
    fitted, held = (recording if copies is None else copies.without(recording)).split(hold_out, train)
    if copies is None:
        first, own = len(held.trajectories), (*held.trajectories, *fitted.trajectories)
        copies = Copies.of(replace(recording, trajectories=own), inputs, range(first))
        kept = [copies.kept(tr, i) for i, tr in enumerate(own)]
        left = [[tr for tr in part if tr is not None] for part in (kept[first:], kept[:first])]
        if not left[0]:
            raise UsageError(
                f"hold_out: what is left for the fit is a copy of what is held out ({copies.told}); expected other "
                "measurements; hold out other trajectories",
                ("diagnose", "hold_out"),
            )
        fitted, held = (replace(p, trajectories=tuple(trs)) for p, trs in zip((fitted, held), left, strict=True))
    return (fitted, held), copies


@final
@dataclass(frozen=True)
class DiagnosisProblem:
    """Why does a model differ from a recording? The arguments of `diagnose`, with defaults made and effects built.

    fitted, held_out: the parts of the recording. clock: times the parts of the work, and tells its progress.
    """

    model: Model
    recording: Recording
    fitted: Recording
    held_out: Recording
    effects: Sequence[Effect]
    horizons: Sequence[float]
    window: float | None
    experiment: Mapping[str, Any]
    seed: int
    folder: Path | None
    clock: Clock
    exact: Sequence[str] = ()


class Diagnoser(ABC):
    """A component of kind `diagnoser`: another way to a diagnosis, for models that no search with equations suits."""

    @abstractmethod
    def accepts(self, model: Model) -> bool:
        """Is it for this model? The first that accepts one, by name, answers; the search with equations where none does."""

    @abstractmethod
    def diagnose(self, problem: DiagnosisProblem) -> Diagnosis:
        """The answer, without its timings: these are the laps of the problem's clock."""


@final
class Clock:
    """Wall time per part in s, and progress for observers."""

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


@final
class Spared:
    """Runs what comes after the answer: what fails there costs its own part only, and is told in a sentence."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def __call__(self, part: str, otherwise: U, make: Callable[..., T], *given: Any) -> T | U:
        """`make(*given)`, or `otherwise` where it fails."""
        try:
            return make(*given)
        except Exception as error:  # a defect after the answer must not take it along
            self.told.append(
                f"the {part} could not be made ({type(error).__name__}: {error}); please report it; the answer stands"
            )
            return otherwise


def _searched(problem: DiagnosisProblem) -> Diagnosis:
    """With equations: effects are added to them, and what does not pay is dropped."""
    data, lap, seed, spared, asked = Data.of(problem), problem.clock.lap, problem.seed, Spared(), problem.experiment
    limits = Limits.of(data.library.model, data.library.measured, asked.get("limits"), asked.get("seconds"))
    lap("evidence")

    settled, windows = _settled(data, problem)
    if (quiet := data.quieter(problem, *settled.found)) is not None:
        like = settled if windows is data.windows and not settled.settings else None
        data, windows = quiet, quiet.windows
        if like is None or (alike := _as_before(data, problem, like)) is None:
            settled, windows = _settled(data, problem, None if like is None else like.search)
        else:
            settled = alike
    if not settled.found[0] and (begun := data.whole(problem, settled.found[1])) is not None:
        data = begun
        settled, windows = _settled(data, problem)
    lap("search")

    answer, judges = _judged(settled, windows, data.held, problem)
    pushed = spared("list of pushes", (), _pushes, problem, data, answer, spared.told)
    more = len(pushed) > sum(c.effect.name == PUSH for c in answer.causes)
    loud = bool((np.sqrt(answer.fit.chi) > THRESHOLDS.loud_channel).any())
    calm = spared("search between pushes", None, data.calm, problem, pushed) if more and loud else None
    if calm is not None:
        data, plain, whole = calm, answer.nothing, judges[-1].error(answer.fit)
        settled, windows = _settled(data, replace(problem, effects=[e for e in problem.effects if e.name != PUSH]))
        answer, judges = _judged(settled, windows, data.held, problem)
        answer = replace(answer, plain=plain)
    elif settled.settings:
        answer = replace(answer, plain=fit(data.library.hypothesis(()), answer.fit.windows))
    judge, settings = judges[-1], settled.settings
    answer = _largest_first(answer, judge)
    named = tuple(_set(answer, s, judge) for s in settings) + tuple(_named(answer, c, judge) for c in answer.causes)
    named += tuple(_read(answer, c, numbers, judge) for c, numbers in answer.library.seen)
    if calm is not None:
        named += _outside(pushed, _share(judge.error(answer.fit), whole))
    lap("rivals")

    gain = {f"{j.horizon:g}": j.gains(answer.nothing, answer.fit, seed) for j in judges}
    lap("gain")
    dataset = answer.dataset
    told = answer.causes, answer.fit, answer.ties, dataset, limits, seed
    design, separable, besides = spared("experiment", (None, (), {}), told_apart, *told)
    lap("experiment")
    whole_model = data.library.extended(answer.causes, answer.fit.values)
    left = spared("test of what is left", None, leftover.left, whole_model, answer.fit, judge.horizon, seed)
    doubted = doubt(answer.fit)
    undecided = design is not None or bool(answer.ties and spared.told)
    odd = bool(doubted and not named) or any(f.startswith("implausible") for c in named for f in c.flags)

    def near(share: float) -> bool:
        return close(judge, answer.fit, seed, share)

    beyond, before = (float(np.sum(np.maximum(judge.floors(f) ** 2 - 1, 0.0))) for f in (answer.fit, answer.nothing))
    stays = beyond / max(before, 1e-300)
    laws = len(answer.causes) + len(settings) + len(answer.library.seen)
    verdict: Verdict = "unexplained"
    if left is not None:
        verdict = leftover.verdict(len(named), left, answer.fit, answer.nothing, undecided, odd, near, stays)
        named = tuple(replace(c, flags=(*c.flags, *leftover.doubts(laws, left, answer.fit, len(settings)))) for c in named)
    if pushed and verdict == "nothing":
        verdict = "unexplained"
    lap("leftover")
    ties = [tuple(c.told for c in tie) for tie, _ in answer.ties]
    ties += [(("engine-setting", s.runner_up.setting),) for s in settings if s.runner_up and s.margin < THRESHOLDS.tie_score]
    missing = verdict == "unexplained" and left is not None
    rest = spared("kind of what is missing", None, leftover.unexplained, left, pushed) if missing else None
    correction = None if rest is None else rest.correction
    changed = f"setting {' and '.join(s.variant.setting for s in settings)}"
    first = (changed, answer.plain) if settings and answer.plain is not None else None
    return Diagnosis(
        verdict,
        named,
        _misfits(answer),
        gain,
        _extended(answer, problem.model.period, pushed if calm and len(problem.recording.trajectories) == 1 else ()),
        tuple(ties),
        _experiment(answer, separable, besides),
        rest,
        spared("pictures", None, figure, answer.search, answer.causes, answer.fit, judge, design, correction, first),
        design=design,
        evidence={} if left is None else spared("tests of the residual", {}, leftover.evidence, left),
        negligible=_negligible(answer),
        smallest=spared("smallest sizes", (), smallest, answer.search) if verdict == "nothing" else (),
        log={**dataset.log, "hold": dataset.hold or "undeclared"},
        assumptions=(*data.assumptions, *doubted, *_chosen(answer)),
        # How long the experiments were, of which none tells the ties apart.
        seconds=limits.seconds if answer.ties and limits.inputs and not design else None,
        warnings=(*coarse(answer.fit), *spared.told),
        refitted=_refitted(answer),
        pushes=pushed,
    )


def _judged(
    settled: Settled, windows: Windows, held: Dataset, problem: DiagnosisProblem
) -> tuple[Answer, tuple[Stretches, ...]]:
    """The answer as held-out data have it, and rollouts over these, with inputs held as it holds them."""
    answer = answered(settled.search, settled.found, windows)
    judges = stretches(replace(held, hold=answer.dataset.hold), problem.horizons, answer.fit)
    answer = decided(answer, judges, problem.seed)
    if (more := completed(settled.search, answer, judges[-1], problem.seed)) is not None:
        larger = decided(answered(settled.search, more, windows), judges, problem.seed)
        if judges[-1].error(larger.fit) < judges[-1].error(answer.fit):
            answer = replace(larger, chosen=True)
    return answer, judges


def _chosen(answer: Answer) -> tuple[str, ...]:
    """That a choice has seen the data by which its gain is measured, in words."""
    told = "the held-out data, by which the gain is measured, also had a say in which of several rivals is named"
    return (told,) if answer.chosen else ()


def _settled(data: Data, problem: DiagnosisProblem, like: FittedSets | None = None) -> tuple[Settled, Windows]:
    """What a search found, and in which windows; like: a search of the same ones under other noise floors.

    In longer ones where the usual ones are blind to what rollouts over the longest horizon show, and where it is found there.
    """
    tell = problem.clock.tell
    first = across(data.library, problem.effects, data.windows, tell, like)
    judge, found, fitted = first.search.far, first.found[1], data.library.measured
    if judge is None or problem.window is not None or fitted.exact or not blind(judge, found, problem.seed):
        return first, data.windows
    length = _length(fitted, problem.model, None, judge.horizon)
    windows = fitted.windows(length).thinned(THRESHOLDS.fitted_values, THRESHOLDS.guard_windows)
    if length < THRESHOLDS.longer_window * data.windows.length:
        return first, data.windows
    again = across(data.library, problem.effects, windows, tell)
    if judge.error(again.search.nothing) <= judge.error(again.found[1]):
        again = replace(again, found=((), again.search.nothing))
    one, two = (float(np.sum(np.maximum(judge.floors(f) ** 2 - 1, 0.0))) for f in (again.found[1], found))
    return (again, windows) if one < THRESHOLDS.foretold_share**2 * two else (first, data.windows)


def _as_before(data: Data, problem: DiagnosisProblem, old: Settled) -> Settled | None:
    """What was found under another floor of the only channel, under its own: all scores change alike, and a search takes the
    same steps. None where there are more channels, or what is left becomes noise, or rough, or too little for the windows.
    """
    causes, before = old.found
    windows, hold = data.windows, old.search.windows.measured.hold
    if len(before.chi) > 1:
        return None
    windows = windows if hold is None else windows.with_hold(hold)
    sets = FittedSets(data.library, windows.guard()[0], problem.clock.tell, like=old.search)
    sets.cautious, sets.negligible = old.search.cautious, dict(old.search.negligible)
    now = sets.fit(causes, None, before.values)
    seeing = sets.far is None or problem.window is not None or not blind(sets.far, now, problem.seed)
    if noise(now, THRESHOLDS.sure_errors) or noise(before, THRESHOLDS.sure_errors) or now.rough != before.rough or not seeing:
        return None
    return Settled(sets, (causes, now), ())


@final
@dataclass(frozen=True)
class Data:
    """All data of a diagnosis in the terms of its model: what is fitted, as it is read and in windows, and what is held out.

    assumptions: what is taken for granted of them, in words.
    """

    library: Library
    windows: Windows
    held: Dataset
    assumptions: tuple[str, ...]

    def quieter(self, problem: DiagnosisProblem, causes: Causes, found: Fit) -> Data | None:
        """With noise floors that a fit shows to be lower, as differences of what jumps are no noise; None where none is."""
        rows = found.residual.reshape(found.windows.y.shape)
        model = self.library.extended(causes, found.values)
        less = self.library.measured.quieter(model, rows, problem.recording.noise)
        if less is None:
            return None
        library = self.library.under(self.library.model, problem.effects, less)
        held = replace(self.held, sigma=library.measured.sigma)
        return replace(self, library=library, windows=replace(self.windows, measured=library.measured), held=held)

    def whole(self, problem: DiagnosisProblem, found: Fit) -> Data | None:
        """With windows from the first samples on, where a fit leaves far more of these: what acts only there is seen."""
        m, length = replace(self.library.measured, whole=True), self.windows.length
        first = [(i, m.history) for i, y in enumerate(m.outputs) if len(y) >= m.history + length]
        if self.library.measured.history == m.history or not first:
            return None
        begun = followed(found.hypothesis, found.theta, m.at(np.array(first), length))
        if (begun.chi < THRESHOLDS.push_rare * np.maximum(found.chi, 1.0)).all():
            return None
        library = self.library.under(self.library.model, problem.effects, m)
        windows = library.measured.windows(length).thinned(THRESHOLDS.fitted_values, THRESHOLDS.guard_windows)
        return replace(self, library=library, windows=windows)

    def calm(self, problem: DiagnosisProblem, pushed: Sequence[Push]) -> Data | None:
        """Between pushes, where these are an effect that may be named, no law of a place, and enough is left between them."""
        effects, names = [e for e in problem.effects if e.name != PUSH], [tr.name for tr in problem.recording.trajectories]
        if not pushed or len(effects) == len(problem.effects):
            return None
        if not elsewhere(problem.model, Dataset.of(problem.model, problem.recording), names, pushed):
            return None
        fitted = self.windows.measured.between(_at(pushed, problem.fitted))
        held = self.held.between(_at(pushed, problem.held_out)) or self.held
        length = self.windows.length
        while fitted is not None and length >= THRESHOLDS.usual_samples:
            try:
                windows = fitted.windows(length).thinned(THRESHOLDS.fitted_values, THRESHOLDS.guard_windows)
                windows.guard()
            except UsageError:
                length //= 2
                continue
            try:
                stretches(held, problem.horizons)
            except UsageError:
                held = self.held
            return replace(self, library=self.library.under(self.library.model, effects, fitted), windows=windows, held=held)
        return None

    @classmethod
    def of(cls, problem: DiagnosisProblem) -> Data:
        """UsageError where they are too few, or in other terms."""
        model, (with_past, since) = problem.model, problem.recording.led_up(problem.held_out)
        rough = Dataset.of(model, problem.fitted)
        length = _length(rough, model, problem.window)
        model, stepping = settled(model, rough.windows(length))
        first = rough if not stepping else Dataset.of(model, problem.fitted)
        if (finer := quickened(model, first.windows(length))) is not model:
            model, first = finer, Dataset.of(finer, problem.fitted)
        library = Library(model, first, problem.effects, max(problem.horizons), problem.exact)
        fitted = library.measured
        held = replace(Dataset.of(model, with_past), sigma=fitted.sigma, spread=fitted.spread, since=since)
        _warned(problem.clock.emit, fitted, held)
        looped = (one.told for one in loops(model, fitted, problem.seed))
        assumed = (*stepping, *kept_within(model, fitted, held), *_untried(library), *looped)
        windows = fitted.windows(_length(fitted, model, problem.window))
        windows = windows.thinned(THRESHOLDS.fitted_values, THRESHOLDS.guard_windows)
        stretches(held, problem.horizons)  # refuses before the search is paid for
        return cls(library, windows, held, assumed)


def _at(pushed: Sequence[Push], recording: Recording) -> list[tuple[int, float, float]]:
    """(trajectory of a part of the recording, from, until in s) of pushes."""
    return [
        (i, p.t, p.t + p.duration)
        for i, tr in enumerate(recording.trajectories)
        for p in pushed
        if tr.name == p.trajectory or tr.name.startswith(f"{p.trajectory} from ")
    ]


def _pushes(problem: DiagnosisProblem, data: Data, answer: Answer, told: list[str]) -> tuple[Push, ...]:
    """All along the recording, where more than noise is left without them; none where that cannot be fitted, as is told."""
    try:
        return _listed(problem, data, answer)
    except UsageError as error:
        told.append(f"pushes could not be looked for ({error}); the answer stands")
        return ()


def _listed(problem: DiagnosisProblem, data: Data, answer: Answer) -> tuple[Push, ...]:
    named = tuple(c for c in answer.causes if c.effect.name == PUSH)
    causes = without(answer.causes, named)
    last = answer.search.fit(causes, (answer.causes, answer.fit)) if named else answer.fit
    held = data.held
    if (room := max(len(y) - held.first(i) for i, y in enumerate(held.outputs))) >= THRESHOLDS.window_samples:
        late = followed(last.hypothesis, last.theta, held.windows(min(last.windows.length, room)))
        if noise(last) and noise(late, THRESHOLDS.sure_errors):
            return ()
    whole = Dataset.of(problem.model, problem.recording)
    whole = replace(whole, sigma=held.sigma, spread=held.spread, hold=answer.dataset.hold)
    names = [tr.name for tr in problem.recording.trajectories]
    law = registry().build("effect", PUSH)
    if causes and np.median(answer.search.nothing.each.max(axis=1)) < THRESHOLDS.coarse_residual:
        # Causes may stand in for pushes: where these leave noise without them, as in most windows, they are the answer.
        found = pushes(lambda values: data.library.extended((), values), answer.search.nothing, whole, names, law)
        between = data.windows.measured.between(_at(found, problem.fitted)) if found else None
        if between is not None and noise(fit(data.library.hypothesis(()), between.windows(data.windows.length))):
            return found
    return pushes(lambda values: data.library.extended(causes, values), last, whole, names, law)


def _outside(pushed: Sequence[Push], explained: float) -> tuple[Cause, ...]:
    """Pushes as causes, one per site, with the numbers of the largest there."""
    sites = dict.fromkeys(p.site for p in sorted(pushed, key=lambda p: -p.size))
    causes = []
    for largest in (max((p for p in pushed if p.site == s), key=lambda p: p.size) for s in sites):
        half = largest.force * (largest.high - largest.low) / (2 * largest.size)
        known = {
            "force": Estimate.of(largest.sign * largest.force, half, largest.force_unit),
            "time": Estimate.of(largest.t, 0.0, "s"),
            "duration": Estimate.of(largest.duration, 0.0, "s"),
        }
        causes.append(Cause(PUSH, largest.site, known, explained))
    return tuple(causes)


def _untried(library: Library) -> Iterator[str]:
    """Which effects need a position that the data do not show, and which inputs never act, in words."""
    if library.idle:
        yield f"nothing was tried at {', '.join(library.idle)}, which moves nothing in these data"
    for site, group in itertools.groupby(sorted(library.aside, key=lambda c: c.site), key=lambda c: c.site):
        names = ", ".join(dict.fromkeys(c.told[0] for c in group))
        yield f"effects that depend on where {site} is were not tried, as no output shows how it moves: {names}"


def _warned(emit: Emit, fitted: Dataset, held: Dataset) -> None:
    """What is changed in a log is told, however little else is: once where both parts say the same."""
    parts = ("held out, and of what led up to them", held), ("fitted", fitted)
    said = {"; ".join(repairs(m.log)): where for where, m in parts}
    for text, where in reversed(said.items()):
        if text:
            emit(Event("warning", "recording", {"message": f"of the data that are {where}: {text}"}))


def _largest_first(answer: Answer, judge: Stretches) -> Answer:
    """Causes by the held-out error that each of them missing would leave: the order of finding is the search's own affair."""
    return replace(answer, causes=tuple(sorted(answer.causes, key=lambda c: _missing(answer, c, judge), reverse=True)))


def _missing(answer: Answer, c: Candidate, judge: Stretches) -> float:
    """The held-out error with all causes but one."""
    return judge.error(answer.search.fit(without(answer.causes, (c,)), (answer.causes, answer.fit)))


def _refitted(answer: Answer) -> dict[str, dict[str, Any]]:
    """The stated parameters that have a tolerance, and what the data make of them beside the causes."""
    library, known = answer.library, answer.fit.estimates()
    freed = {library.extension(c).frees for c in answer.causes}
    loose = [p for p in library.model.parameters if p.tolerance > 0 and p.name in known and p.name not in freed]
    return {p.name: {"stated": p.value, **vars(Estimate.of(*known[p.name], p.unit))} for p in loose}


def _effects(effects: Sequence[Effect | str] | Literal["all"]) -> list[Effect]:
    known = registry()
    names = known.names("effect") if effects == "all" else effects
    found: list[Effect] = [known.build("effect", e) if isinstance(e, str) else e for e in names]
    if not found:
        raise UsageError("diagnose: no effect is given; name at least one, or `all`")
    return found


def _timed(model: Model, recording: Recording, horizons: Sequence[float] | None) -> None:
    """Refuses rows in no order, no horizon, and one below a sample: as a rule times in another unit than they are read in."""
    ordered(recording)
    if horizons is not None and not horizons:
        raise UsageError("diagnose: no horizon is given; name at least one in seconds, such as [0.5], or leave them out")
    period, shortest = recording.period, min(horizons or [0.0])
    if 0 < shortest < (1 - JITTER) * period:
        raise UsageError(
            f"diagnose.horizons: {shortest:g} s is shorter than {period:.6g} s, the period of the recording; expected at least "
            "that; is its time in s? Give the unit of that column otherwise, recording.units: {TIME: ms}, or longer horizons",
            ("diagnose", "horizons"),
        )
    agreeing(model, recording)


def _length(measured: Dataset, model: Model, window: float | None, wanted: float | None = None) -> int:
    """In samples, as it is asked for, or `wanted` s (default: as usual) where the data are long enough for several such."""
    lengths = sorted(len(y) - measured.history for y in measured.outputs)
    # A few that are shorter than the others do not shorten all windows.
    most = lengths[int(np.argmax(np.cumsum(lengths) > THRESHOLDS.skipped_share * sum(lengths)))]
    usual = measured.samples(wanted or (THRESHOLDS.window if len(model.coordinates) < 2 else THRESHOLDS.coupled_window))
    if window is None:
        count = THRESHOLDS.guard_windows if wanted else THRESHOLDS.usual_windows
        length = max(THRESHOLDS.usual_samples, min(usual, sum(lengths) // count, most))
        # Runs are cut into windows without a rest: no fewer of them, and all of a run counts.
        return max(THRESHOLDS.usual_samples, most // max(1, round(most / length))) if len(lengths) > 1 else length
    if (own := measured.samples(window)) < THRESHOLDS.window_samples:
        raise UsageError(
            f"diagnose.window: {window:g} s hold {own} samples, {measured.period:g} s apart; expected "
            f"{THRESHOLDS.window_samples} or more; give "
            f"{THRESHOLDS.window_samples * measured.period:g} s, or leave it out",
            ("diagnose", "window"),
        )
    return own


def _named(answer: Answer, c: Candidate, judge: Stretches) -> Cause:
    """A cause with its numbers, its share, its runner-up, and what speaks against it."""
    library, last, before = answer.library, answer.fit, _missing(answer, c, judge)
    runner_up = None
    for rival, fitted in answer.rivals[c.key][:1]:
        other = without(rival, without(answer.causes, (c,)))[0]
        runner_up = Rival(
            *other.told, _share(judge.error(fitted), before), answer.search.better(last, fitted), judge.rms(fitted)
        )
    share = _share(judge.error(last), before)
    native = library.model.native(*c.told)
    slip = unit_slip(library, c, last)
    return Cause(*c.told, _numbers(library, c, last), share, runner_up, native, flags(library, c, last), unit_slip=slip)


def _set(answer: Answer, s: Setting, judge: Stretches) -> Cause:
    """A setting of the engine: what it explains beside all other causes, refitted without it."""
    h = s.before.under(s.before.model).hypothesis(answer.causes)
    before = judge.error(fit(h, answer.fit.windows, theta=h.theta(answer.fit.values)))
    v, numbers = s.variant, dict[str, Estimate]()
    if isinstance(v.value, int | float) and not isinstance(v.value, bool):
        numbers["value"] = Estimate.of(float(v.value))
    rival = None
    if s.runner_up is not None:
        other = fit(s.before.under(s.runner_up.model).hypothesis(()), answer.fit.windows)
        rival = Rival("engine-setting", s.runner_up.setting, _share(judge.error(other), before), s.margin, judge.rms(other))
    share = _share(judge.error(answer.fit), before)
    changed = {"value": v.value, "was": v.was}
    return Cause("engine-setting", v.setting, numbers, share, rival, v.native, setting=changed)


def _read(answer: Answer, c: Candidate, numbers: Mapping[str, float], judge: Stretches) -> Cause:
    """A cause that shows in the measured values alone: explained is what it makes of the error without taking part in it."""
    library, m = answer.library, judge.windows.measured
    channel = [s.name for s in m.channels].index(c.site)
    before = judge.error(answer.fit) ** 2
    # All of the noise floor, where the rounding is most of it.
    left = max(0.0, before - m.sigma[channel] ** 2 / m.spread[channel] ** 2 / len(m.channels))
    rows = zip(library.parameters(c).items(), library.units(c), strict=True)
    known = {p.name: Estimate.of(numbers[n], unit=unit) for (n, p), unit in rows}
    return Cause(*c.told, known, _share(math.sqrt(left), math.sqrt(before)))


def _extended(answer: Answer, period: float, pushed: Sequence[Push] = ()) -> Model:
    """With the period of the model that was asked about."""
    library, numbers = answer.library, answer.fit.values
    for _, found in library.seen:
        numbers |= found
    model = library.extended((*answer.causes, *(c for c, _ in library.seen)), numbers)
    law: Effect = registry().build("effect", PUSH)
    for p in pushed:
        e, known = law.extension(p.site, model), (p.sign * p.force, p.t, p.duration)
        own = tuple(replace(n, value=v) for n, v in zip(e.parameters, known, strict=True))
        model = model.extend([replace(e, parameters=own)])
    return model if model.period == period else paced(model, model.period / period)


def _negligible(answer: Answer) -> tuple[tuple[str, str, float], ...]:
    named, told = {c.told for c in answer.causes}, {c.key: c.told for c in answer.library.candidates}
    shares = {told[k]: share for k, share in answer.negligible.items() if told[k] not in named}
    return tuple((*site, share) for site, share in shares.items())


def _numbers(library: Library, c: Candidate, last: Fit) -> dict[str, Estimate]:
    parameters, known = c.effect.parameters, [last.estimates()[n] for n in library.names(c)]
    shown = c.effect.canonical({p.name: value for p, (value, _) in zip(parameters, known, strict=True)})
    rows = zip(parameters, known, library.units(c), strict=True)
    return {p.name: Estimate.of(shown[p.name], half, unit) for p, (_, half), unit in rows}


def _share(after: float, before: float) -> float:
    """Of an error in deviations of the motion: one that runs away further says no more than 1."""
    return 1 - after / min(before, 1.0) if before > 0 else 0.0


def _misfits(answer: Answer) -> dict[str, Misfit]:
    m = answer.dataset
    old, new = (np.sqrt(f.chi) * m.sigma for f in (answer.nothing, answer.fit))
    return {c.name: Misfit(*map(float, row)) for c, *row in zip(m.channels, old, new, m.sigma, strict=True)}


def _experiment(answer: Answer, separable: Sequence[bool], besides: Mapping[int, str]) -> str | None:
    """What would tell the first tie apart that no input separates, and what to measure besides; else what tells the first."""
    pairs = list(itertools.combinations([answer.causes, *(t for t, _ in answer.ties)], 2))
    open_ = [i for i, yes in enumerate(separable) if not yes] or [0]
    for i in open_ if answer.ties else ():
        a, b = ((without(*p) or p[0])[0] for p in (pairs[i], pairs[i][::-1]))
        known = a.effect.rivals.get(b.told[0]) or b.effect.rivals.get(a.told[0])
        text = known or f"{a.effect.experiment}; {b.effect.experiment}"
        if not (separable and separable[i]) and a.site != b.site:
            text = f"measure {', or '.join(_MEASURED.get(c.effect.site, '{} by itself').format(c.site) for c in (a, b))}"
        if i in besides:
            text = besides[i] if a.site == b.site else f"{text}; or {besides[i]}"
        return f"to tell {a.told[0]} at {a.site} from {b.told[0]} at {b.site}: {text}"
    return None
