"""diagnose() where the simulation is a physics engine that no equations stand in for: which of its own numbers is wrong?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Emit, Event, Model, Recording, UsageError, difference
from gapcert_diagnosis.diagnose import Diagnoser, DiagnosisProblem
from gapcert_diagnosis.results import Cause, Diagnosis, Estimate, Gain, Misfit, Rival, Verdict
from gapcert_diagnosis.search.criterion import agreement
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import NativeModel
from gapcert_figures import Channel, DiagnosisFigure, Waterfall, called, state_playback

from .candidates import NativeCandidate, native_candidates
from .rollouts import ErrorStore, Motions, sensitivity
from .stepwise import EngineSearch, NativeFit


@final
class NativeDiagnoser(Diagnoser):
    """Of a physics engine that no equations stand in for: it is rolled out itself."""

    def accepts(self, model: Model) -> bool:
        return isinstance(model, NativeModel)

    def diagnose(self, problem: DiagnosisProblem) -> Diagnosis:
        """The native parameters and settings that are wrong: fitted to one part of a recording, judged on the other.

        Rollouts start from measured states, in flight from what its first samples say, over a short window and over the longest
        horizon; a horizon longer than a trajectory ends with it. A trajectory is one voice: causes are named where trajectories
        that a fit has not seen agree, beyond chance among so many candidates; intervals come from drawing trajectories again.
        """
        model = problem.model
        assert isinstance(model, NativeModel)
        parts, horizons, seed, lap = (problem.fitted, problem.held_out), problem.horizons, problem.seed, problem.clock.lap
        fitted, held = _checked(model, parts)
        tell = _counted(problem.clock.emit)
        entries = native_candidates(model, {e.name for e in problem.effects}, simulated=bool(parts[0].noise))
        store = ErrorStore(None if problem.folder is None else problem.folder / "scores")
        lap("evidence")
        search = EngineSearch(
            model, fitted, entries, sorted({problem.window or THRESHOLDS.contact_window, max(horizons)}), store, tell
        )
        best = search.select()
        lap("search")
        judge = _Judge(held, tuple(sorted(horizons)), store)
        causes = tuple(_named(search, best, c, judge, seed) for c in best.causes)
        lap("rivals")
        gain = judge.gains(model, best.model, seed)
        lap("gain")
        left = _left(search.few, best.model, min(search.horizons), seed)
        visible = _visible(search, best)
        lap("leftover")
        verdict = _verdict(causes, left, judge.error(model), judge.error(best.model))
        if causes and (bad := {n: v for n, v in left.items() if v > THRESHOLDS.left_errors}):
            worst, short = max(bad, key=lambda n: bad[n]), min(search.horizons)
            text = f"inadequate: over {short:g} s, errors of {worst} are still {bad[worst]:.2g} times those of noise"
            causes = (*causes[:-1], replace(causes[-1], flags=(*causes[-1].flags, text)))
        return Diagnosis(
            verdict,
            causes,
            _misfits(search, best),
            gain,
            best.model,
            _ties(search, best),
            None,
            None,
            _figure(search, judge, best),
            negligible=tuple((*k, s) for k, s in search.negligible.items() if k not in {c.key for c in best.causes}),
            evidence={"error over that of noisy starts": left},
            log={"trajectories fitted": len(fitted), "trajectories held out": len(held),
                 "error": "mean length of the difference from measured starts", **visible},
        )  # fmt: skip


def _checked(model: NativeModel, parts: tuple[Recording, Recording]) -> tuple[Motions, Motions]:
    fitted, held = (Motions.of(model, part) for part in parts)
    if min(len(fitted), len(held)) < THRESHOLDS.contact_trajectories:
        raise UsageError(
            f"diagnose: {len(fitted)} trajectories are fitted and {len(held)} held out; expected at least "
            f"{THRESHOLDS.contact_trajectories} on either "
            f"side, since one trajectory is one voice; record more, or cut long ones",
            ("diagnose", "hold_out"),
        )
    return fitted, held


def _counted(emit: Emit) -> Callable[..., None]:
    """Tells observers what is tried, and how much was."""
    numbers = itertools.count(1)

    def tell(text: str, best: Mapping[str, Any] | None = None) -> None:
        more = {"best": best} if best else {}
        emit(Event("progress", "diagnosis", {"done": next(numbers), "unit": "hypotheses", "text": text, **more}))

    return tell


@final
class _Judge:
    """Held-out rollouts."""

    def __init__(self, motions: Motions, horizons: tuple[float, ...], store: ErrorStore) -> None:
        self.motions, self.horizons, self.store = motions, horizons, store
        self.names = [g.output.name for g in motions.model.groups]

    def errors(self, model: NativeModel) -> Array:
        """(trajectories, horizons, groups, 3)."""
        return self.store.errors(self.motions, model, self.horizons)

    def error(self, model: NativeModel) -> float:
        """E: root mean square over groups at the longest horizon, each divided by its size in the data."""
        return float(np.sqrt(np.mean(self.errors(model)[:, -1, :, 0] / self.motions.spread**2)))

    def gains(self, before: NativeModel, after: NativeModel, seed: int) -> dict[str, dict[str, Gain]]:
        """Mean errors, with intervals from trajectories drawn again."""
        old, new = self.errors(before)[..., 1], self.errors(after)[..., 1]
        n = len(new)
        drawn = np.random.default_rng(seed).integers(n, size=(THRESHOLDS.resamples, n))
        low, high = np.quantile(new[drawn].mean(axis=1), [0.025, 0.975], axis=0)
        out: dict[str, dict[str, Gain]] = {}
        for h, horizon in enumerate(self.horizons):
            table = np.stack([old[:, h].mean(axis=0), new[:, h].mean(axis=0), low[h], high[h]], axis=1).tolist()
            out[f"{horizon:g}"] = {name: Gain(*row) for name, row in zip(self.names, table, strict=True)}
        return out

    def means(self, model: NativeModel) -> dict[str, float]:
        """Per group, at the longest horizon."""
        return dict(zip(self.names, self.errors(model)[:, -1, :, 1].mean(axis=0).tolist(), strict=True))


def _named(search: EngineSearch, best: NativeFit, c: NativeCandidate, judge: _Judge, seed: int) -> Cause:
    rest = search.without(best, c)
    before, after = judge.error(rest.model), judge.error(best.model)
    rival = None
    if (r := search.rivals.get(c.key)) is not None:
        share = 1 - judge.error(r.model) / before
        rival = Rival(*r.causes[-1].key, share, _margin(search, best, r), judge.means(r.model))
    share, twins = 1 - after / before if before > 0 else 0.0, search.twins.get(c.native)
    flags = (f"not told apart from {', '.join(twins)}, which does the same in a contact",) if twins else ()
    return Cause(*c.key, _estimates(best, c, seed), share, rival, c.native, flags, c.setting)


def _margin(search: EngineSearch, best: NativeFit, rival: NativeFit) -> float:
    """±z² of a rival's scores over the best ones."""
    gained = search.scores(rival.model) - search.scores(best.model)
    return math.copysign(agreement(gained) ** 2, float(gained.mean()))


def _estimates(best: NativeFit, c: NativeCandidate, seed: int) -> dict[str, Estimate]:
    if c.parameter is None:
        return {}
    p = c.parameter
    index = [k.native for k in best.causes if k.option is None].index(c.native)
    low, high = best.interval(index, seed)
    value = best.model.values[c.native]
    ends = sorted((c.back(low), c.back(high)))
    return {c.number: Estimate(c.factor * value, p.unit, c.factor * ends[0], c.factor * ends[1])}


def _verdict(causes: tuple[Cause, ...], left: Mapping[str, float], before: float, after: float) -> Verdict:
    if max(left.values()) <= THRESHOLDS.left_errors:
        return "causes" if causes else "nothing"
    return "causes" if causes and after < (1 - THRESHOLDS.enough_explained) * before else "unexplained"


def _misfits(search: EngineSearch, best: NativeFit) -> dict[str, Misfit]:
    """Over the short windows of the fitted part."""
    m, short = search.motions, (min(search.horizons),)
    old, new = (np.sqrt(search.store.errors(m, f.model, short)[:, 0, :, 0].mean(axis=0)) for f in (search.nothing, best))
    names = [g.output.name for g in m.model.groups]
    return {n: Misfit(float(a), float(b), float(s)) for n, a, b, s in zip(names, old, new, m.sigma, strict=True)}


def _ties(search: EngineSearch, best: NativeFit) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Sets with a rival in the place of a cause that trajectories do not put behind."""
    out = []
    for c in best.causes:
        r = search.rivals.get(c.key)
        if r is not None and len(r.causes) <= len(best.causes) and _margin(search, best, r) < THRESHOLDS.tie_z2:
            out.append(tuple(k.key for k in (*(k for k in best.causes if k is not c), r.causes[-1])))
    return tuple(out)


def _left(motions: Motions, model: NativeModel, horizon: float, seed: int) -> dict[str, float]:
    """Median over trajectories of the error over that of a perfect model whose starts, and the measurement, have noise."""
    rng = np.random.default_rng(seed)
    pieces = motions.pieces(horizon)
    try:
        noisy = _noisy(motions, motions.starts(model, pieces), rng)
        _, truth = motions.rolled(model, horizon)
        _, moved = motions.rolled(model, horizon, noisy)
    except UsageError:
        return {g.output.name: math.inf for g in model.groups}
    known = motions.compared(pieces, moved, truth)[..., 0] + motions.sigma**2
    seen = motions.errors(model, horizon)[..., 0]
    ratio = np.sqrt(np.median(seen / known, axis=0)).tolist()
    return dict(zip([g.output.name for g in model.groups], ratio, strict=True))


def _noisy(motions: Motions, x: Array, rng: np.random.Generator) -> Array:
    """Starts with the noise floor of every group added."""
    out = x.copy()
    for g, sigma in zip(motions.model.groups, motions.sigma, strict=True):
        columns = list(g.columns)
        if g.specs[0].kind == "quaternion":
            half = rng.normal(size=(len(x), 3)) * sigma / math.sqrt(3) / 2
            w, v = x[:, columns[:1]], x[:, columns[1:]]
            turned = np.concatenate([w - np.sum(half * v, axis=1, keepdims=True), v + w * half + np.cross(half, v)], axis=1)
            out[:, columns] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        else:
            out[:, columns] += rng.normal(size=(len(x), len(columns))) * sigma / math.sqrt(len(columns))
    return out


def _visible(search: EngineSearch, best: NativeFit) -> dict[str, Any]:
    """Native parameters by what a change of 5 % does to short rollouts: in noise floors, not at all, or alike."""
    model = best.model.coarse()
    now, changes = {p.name: p.value for p in model.parameters}, dict[str, NativeModel]()
    for n in search.entries:
        if n.parameter is not None and n.option is None:
            value = now[n.native]
            new = value * (1 + THRESHOLDS.probe_step) if value else n.back(n.to(value) + THRESHOLDS.probe_step)
            changes[n.native] = model.restated({n.native: min(max(new, n.parameter.low), n.parameter.high)})
    moved = sensitivity(search.few, model, changes, min(search.horizons))
    size = {n: float(np.sqrt(np.mean(v**2))) for n, v in moved.items()}
    seen = {n: v for n, v in size.items() if v > THRESHOLDS.unseen_effect}
    alike = []
    for a, b in itertools.combinations(seen, 2):
        together = float(moved[a] @ moved[b]) / math.sqrt(float(moved[a] @ moved[a]) * float(moved[b] @ moved[b]))
        if abs(together) > THRESHOLDS.alike_numbers:
            alike.append(f"{a} and {b}")
    alike += [f"{a} and {b}" for a, twins in search.twins.items() for b in twins]
    hidden = sorted(n for n, v in size.items() if v <= THRESHOLDS.unseen_effect)
    out: dict[str, Any] = {"native parameters that show (noise floors per 5 %)": {n: round(v, 3) for n, v in seen.items()}}
    out |= {"native parameters that these data do not show": hidden} if hidden else {}
    return out | ({"native parameters that these data do not tell apart": alike} if alike else {})


def _figure(search: EngineSearch, judge: _Judge, best: NativeFit) -> DiagnosisFigure:
    """The held-out trajectory whose error before is the median, group by group; and what each cause explained."""
    grown = [best]
    while grown[0].causes:
        grown.insert(0, search.without(grown[0], grown[0].causes[-1]))
    m = judge.motions
    worst = judge.errors(search.model)[:, -1, 0, 0]
    k = int(np.argsort(worst)[len(worst) // 2])
    one = m.take([k])
    horizon = judge.horizons[-1]
    (piece, *_), before = one.rolled(search.model, horizon)
    _, after = one.rolled(best.model, horizon)
    steps = piece[2]
    channels: list[Channel] = []
    for g in m.model.groups:
        columns = list(g.columns)
        y = one.states[0][: steps + 1, columns]
        # A rotation is drawn as the rotation vector from its start.
        first = np.broadcast_to(y[:1], y.shape)
        flat = [difference(g.specs, a, first) if g.specs[0].kind == "quaternion" else a
                for a in (y, before[0, : steps + 1, columns].T, after[0, : steps + 1, columns].T)]  # fmt: skip
        names = [s.name for s in g.specs] if flat[0].shape[1] == len(g.specs) else [f"{g.specs[0].name}.{a}" for a in "xyz"]
        t = one.t[0][: steps + 1]
        channels += [Channel(n, g.output.unit, t, *(f[:, j] for f in flat)) for j, n in enumerate(names)]
    whole = {"measured": one.states[0][: steps + 1], "before": before[0, : steps + 1], "after": after[0, : steps + 1]}
    played = state_playback(whole, one.t[0][: steps + 1], m.model)
    if not best.causes:
        return DiagnosisFigure(tuple(channels), (), playback=played)
    labels = ("none of the causes", *(called(*c.key) for c in best.causes))
    waterfall = Waterfall(labels, np.array([judge.error(f.model) for f in grown]))
    return DiagnosisFigure(tuple(channels), (), waterfall, playback=played)
