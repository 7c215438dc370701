"""diagnose(): why is a model wrong? A recording in; causes with evidence, rivals, and what they buy on held-out data out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, final

import numpy as np
from scipy.signal import savgol_filter

from gapcert import leftover
from gapcert.effect import Cause, Diagnosis, Effect, Estimate, Misfit, Rival, Verdict, site_units
from gapcert.errors import UsageError
from gapcert.events import Emit, Event, silent
from gapcert.evidence import Fit
from gapcert.figures import Channel, DiagnosisFigure, Law
from gapcert.gain import Stretches, stretches
from gapcert.measured import Measured
from gapcert.recording import Recording
from gapcert.search import TIE, Candidate, Causes, Library, Search, better, probe, velocity
from gapcert.system import Model, difference

WINDOW = 1.2  # s
LEAST, FEWEST = 30, 8  # samples in a window; windows in the shortest trajectory
LAW_SMOOTHING, LAW_POINTS = 0.06, 400  # s on either side; points of a picture


def diagnose(
    model: Model,
    recording: Recording,
    effects: Sequence[Effect | str] | Literal["all"] = "all",
    *,
    hold_out: Mapping[str, Any] | None = None,
    horizons: Sequence[float] = (0.5,),
    window: float | None = None,
    seed: int = 0,
    emit: Emit = silent,
) -> Diagnosis:
    """The causes of the difference between a model and a recording.

    Measured outputs are compared with simulated ones over windows whose start is free. A cause is named when its fall in score
    pays for its parameters and for the number of rivals, and when a later stretch of the data agrees. The gain is measured by
    free rollouts over `hold_out` (default: the last quarter), which no fit has seen, at the given horizons in s.
    """
    clock = _Clock(emit)
    fitting, held_out = recording.split(hold_out or {"last": 0.25})
    measured = Measured.of(model, fitting)
    held = replace(Measured.of(model, held_out), sigma=measured.sigma, spread=measured.spread)
    judges = stretches(held, horizons)
    library = Library(model, measured, _effects(effects))
    windows = measured.windows(_length(measured, window))
    clock.lap("evidence")

    earlier, later = windows.guard()
    search = Search(library, earlier, clock.tell)
    causes, agreed = search.agreed(*search.forward(), later)
    clock.lap("search")

    whole = Search(library, windows, clock.tell)
    last = whole.fit(causes, (causes, agreed))
    named, ties = _named(whole, causes, last, judges[-1])
    clock.lap("rivals")

    gain = {f"{j.horizon:g}": j.gains(whole.nothing, last, seed) for j in judges}
    clock.lap("gain")

    short_windows, short = leftover.shortened(last, windows)
    remains = leftover.remains(last, short)
    rest = leftover.unexplained(model, short_windows, short) if remains else None
    extended = library.extended(causes, _values(last))
    clock.lap("leftover")

    return Diagnosis(
        _verdict(causes, ties, remains, last, whole.nothing),
        named,
        _misfits(whole.nothing, last, measured),
        gain,
        extended,
        tuple(tuple(c.key for c in tie) for tie in ties),
        _experiment(causes, ties),
        rest,
        _figure(library, causes, whole.nothing, last, judges[-1], extended),
        clock.laps,
    )


@final
class _Clock:
    """Wall time per part, and progress for observers."""

    def __init__(self, emit: Emit) -> None:
        self.emit, self.count, self.last = emit, 0, time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self.last = round(now - self.last, 3), now

    def tell(self, text: str) -> None:
        self.count += 1
        self.emit(Event("progress", "diagnosis", {"done": self.count, "text": text}))


def _effects(effects: Sequence[Effect | str] | Literal["all"]) -> list[Effect]:
    from gapcert.components import registry

    known = registry()
    names = known.names("effect") if effects == "all" else effects
    found: list[Effect] = [known.build("effect", e) if isinstance(e, str) else e for e in names]
    if not found:
        raise UsageError("diagnose: no effect is given; name at least one, or `all`")
    return found


def _length(measured: Measured, window: float | None) -> int:
    shortest = min(len(y) for y in measured.outputs) - measured.history
    return measured.samples(window) if window else max(LEAST, min(measured.samples(WINDOW), shortest // FEWEST))


def _named(search: Search, causes: Causes, last: Fit, judge: Stretches) -> tuple[tuple[Cause, ...], list[Causes]]:
    """Every cause with its numbers, its share and its runner-up; and the other sets that explain the data as well."""
    library = search.library
    after = judge.error(last)
    named, ties = [], []
    for c in causes:
        rest = tuple(k for k in causes if k is not c)
        without = search.fit(rest, (causes, last))
        before = judge.error(without)
        rivals = search.additions(rest, (rest, without), without=(c,))
        ties += [r for r, f in rivals if better(last, f) < TIE]
        runner_up = None
        if rivals:
            rival, fitted = rivals[0]
            runner_up = Rival(*rival[-1].key, _share(judge.error(fitted), before))
        named.append(Cause(*c.key, _numbers(c, library.model, last), _share(after, before), runner_up))
    return tuple(named), ties


def _numbers(c: Candidate, model: Model, last: Fit) -> dict[str, Estimate]:
    names, widths, numbers = last.hypothesis.names, last.interval(), {}
    for short, p in zip(c.effect.parameters, c.effect.named(c.site, model), strict=True):
        value, half = (float(a[names.index(p.name)]) for a in (last.theta, widths))
        numbers[short.name] = Estimate(value, p.unit, value - half, value + half)
    return numbers


def _share(after: float, before: float) -> float:
    return 1 - after / before if before > 0 else 0.0


def _values(last: Fit) -> dict[str, float]:
    return dict(zip(last.hypothesis.names, map(float, last.theta), strict=True))


def _verdict(causes: Causes, ties: list[Causes], remains: bool, last: Fit, nothing: Fit) -> Verdict:
    # Causes that leave a tenth of the excess over the noise are an answer even where something small is left beside them.
    if remains and not (causes and last.chi.mean() - 1 < 0.1 * (nothing.chi.mean() - 1)):
        return "unexplained"
    if not causes:
        return "nothing"
    return "ambiguous" if ties else "causes"


def _misfits(before: Fit, after: Fit, measured: Measured) -> dict[str, Misfit]:
    old, new = (np.sqrt(f.chi) * measured.sigma for f in (before, after))
    return {c.name: Misfit(float(old[i]), float(new[i]), float(measured.sigma[i])) for i, c in enumerate(measured.channels)}


def _experiment(causes: Causes, ties: list[Causes]) -> str | None:
    """What would tell the first tie apart."""
    for tie in ties:
        mine = [c for c in causes if c.key not in {k.key for k in tie}]
        other = [k for k in tie if k.key not in {c.key for c in causes}]
        a, b = mine[0], other[0]
        known = a.effect.rivals.get(b.effect.name) or b.effect.rivals.get(a.effect.name)
        text = known or f"{a.effect.experiment}; {b.effect.experiment}"
        return f"to tell {a.effect.name} at {a.site} from {b.effect.name} at {b.site}: {text}"
    return None


def _figure(library: Library, causes: Causes, before: Fit, after: Fit, judge: Stretches, extended: Model) -> DiagnosisFigure:
    """The first held-out rollout of the longest horizon, and the law at every coordinate that has one."""
    m, w = judge.windows.measured, judge.windows
    t = w.t[0] + m.period * (judge.lead + np.arange(w.length - judge.lead))
    old, new = (judge.simulate(f)[0] for f in (before, after))
    channels = [Channel(c.name, c.unit, t, w.y[0, judge.lead :, i], old[:, i], new[:, i]) for i, c in enumerate(m.channels)]
    sites = dict.fromkeys(c.site for c in causes if c.effect.site == "coordinate")
    return DiagnosisFigure(tuple(channels), tuple(_law(library, s, causes, m, extended) for s in sites))


def _law(library: Library, site: str, causes: Causes, m: Measured, extended: Model) -> Law:
    """The force that the nominal model misses along the measured path, and the force of the named effects."""
    model, x, u = library.model, m.states[0], m.inputs[0]
    response = probe(model, site, x, u)
    v = velocity(model, site, response)
    half = max(2, round(LAW_SMOOTHING / m.period))
    slope = savgol_filter(x[:, v], min(2 * half + 1, (len(x) - 1) | 1), 2, deriv=1, delta=m.period)
    missing = (slope * model.period - difference(model.states, model.step(x, u).x, x)[:, v]) / response[:, v]
    rows = np.linspace(half, len(x) - 1 - half, min(LAW_POINTS, len(x) - 2 * half)).astype(int)
    at = np.zeros((LAW_POINTS, model.nx))
    at[:, v] = np.linspace(x[:, v].min(), x[:, v].max(), LAW_POINTS)
    still = np.zeros((LAW_POINTS, model.nu))
    push = difference(model.states, extended.step(at, still).x, model.step(at, still).x) / probe(model, site, at, still)
    names = [c for c in causes if c.site == site and c.effect.site == "coordinate"]
    units = site_units(model, "coordinate", site)
    axes = f"{model.states[v].name} [{model.states[v].unit}]", f"missing force [{units['force']}]"
    title = f"{' and '.join(c.effect.name for c in names)} at {site}"
    return Law(title, *axes, x[rows, v], missing[rows], at[:, v], push[:, v])
