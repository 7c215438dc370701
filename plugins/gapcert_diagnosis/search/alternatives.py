"""What stands beside the causes: sets that explain as much, runners-up, numbers that are not plausible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from gapcert.plugin import Array, Model
from gapcert_diagnosis.data.dataset import Dataset, Windows
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.fitting.rollout_error import Stretches
from gapcert_diagnosis.residual.adequacy import by_noise, close
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import EngineModel

from .candidates import Candidate, Causes, Library
from .criterion import Found, agreement, ahead, fails, keys, rank, richer, without
from .fitted_sets import FittedSets
from .moves import additions, spared
from .stepwise import judge


@final
@dataclass(frozen=True)
class Answer:
    """The final causes and their fit on all windows, sets that explain as much, and per cause what else could stand for it.

    chosen: did held-out data choose among ties? negligible: (effect, site) → share of the effort of what the search met and
    found too small; plain: the fit of nothing under
    the settings of the model as it was given, where the search is under others.
    """

    search: FittedSets
    causes: Causes
    fit: Fit
    ties: tuple[Found, ...]
    rivals: Mapping[tuple[str, str], tuple[Found, ...]]
    negligible: Mapping[tuple[str, str], float]
    plain: Fit | None = None
    chosen: bool = False

    @property
    def library(self) -> Library:
        return self.search.library

    @property
    def dataset(self) -> Dataset:
        """Of the windows, with the input held as fits best."""
        return self.fit.windows.measured

    def with_answer(self, tie: Found) -> Answer:
        """With one of the ties as the answer, and the answer as one of the ties."""
        come, gone = without(tie[0], self.causes), without(self.causes, tie[0])
        left = [f for c in gone for f in self.rivals[c.key] if keys(f[0]) != keys(tie[0])]
        others = tuple(rank([(self.causes, self.fit), *left], self.search.cautious))
        rivals = {k: f for k, f in self.rivals.items() if k not in keys(gone)} | {c.key: others for c in come}
        instead = {c.key: new for c, new in zip(gone, come, strict=False)}
        stay = [instead.get(c.key, c) for c in self.causes if c not in gone or c.key in instead]
        ties = ((self.causes, self.fit), *(t for t in self.ties if t is not tie))
        return replace(self, causes=(*stay, *come[len(gone) :]), fit=tie[1], ties=ties, rivals=rivals)

    @property
    def nothing(self) -> Fit:
        return self.search.nothing if self.plain is None else self.plain


def answered(search: FittedSets, found: Found, windows: Windows) -> Answer:
    """The set of a search, fitted to all windows, against its rivals; of sets that explain as much, the simplest."""
    hold = search.windows.measured.hold
    whole = FittedSets(search.library, windows if hold is None else windows.with_hold(hold), search.progress)
    whole.cautious = search.cautious
    later = windows.guard()[1]
    found = _richer(search, whole, found, later)
    causes = found[0]
    last = whole.fit_from(causes, found[1])
    rivals = {c.key: _alternatives(search, whole, found, c) for c in causes}
    ties = [t for t in _ties(whole, (causes, last), rivals) if not _refuted(search, t[0], found, later)]
    simplest = _simplest(whole, [(causes, last), *ties])
    answer = Answer(whole, causes, last, tuple(ties), rivals, search.negligible)
    return _told(answer if simplest[0] == causes else answer.with_answer(simplest))


def decided(answer: Answer, judges: Sequence[Stretches], seed: int) -> Answer:
    """As held-out data have it: a tie that foretells them plainly worse is none, one that does so plainly better is the answer,
    and a rival that does is a tie. The longest rollouts say how much worse, and those of any horizon how surely."""
    judge = judges[-1]
    ties = {keys(f[0]): f for f in answer.ties}
    if judge.windows.measured.exact:
        return answer

    def foretells(new: Fit, old: Fit) -> bool:
        def due() -> list[Array]:  # what a rough fit leaves is no noise
            return [np.ones(1) if f.rough else by_noise(judge, f, seed) for f in (new, old)]

        return any(ahead(judge.floors(new), judge.floors(old), j.blocks(new), j.blocks(old), due) for j in judges)

    runners_up = [f for found in answer.rivals.values() for f in found[:1] if keys(f[0]) not in ties]
    surprising = [f for f in runners_up if foretells(f[1], answer.fit)]
    even = [f for f in answer.ties if not foretells(answer.fit, f[1])]
    chosen = bool(surprising) or len(even) < len(answer.ties)
    answer = replace(answer, ties=(*even, *surprising), chosen=chosen)
    better = [f for f in even if foretells(f[1], answer.fit)]
    if not better:
        return answer
    answer = replace(answer.with_answer(min(better, key=lambda f: judge.error(f[1]))), chosen=True)
    return replace(answer, ties=tuple(f for f in answer.ties if not foretells(answer.fit, f[1])))


def completed(search: FittedSets, answer: Answer, judge: Stretches, seed: int) -> Found | None:
    """The causes, or the best single one, with one more, where with it only held-out rollouts are close to the motion.

    Their error falls to a half, in all stretches alike, and falls plainly over the fitted data: of what promises most, what
    foretells these best. A search on windows refuses it where the free starts of these hide much of what it does.
    """
    old, limit, far = answer.fit, THRESHOLDS.close_motion, search.far
    if far is None or judge.windows.measured.exact or close(judge, old, seed, limit):
        return None

    def completes(new: Found) -> bool:
        gone = np.log(judge.blocks(old) + 1e-300) - np.log(judge.blocks(new[1]) + 1e-300)
        halved = (
            judge.error(new[1]) < THRESHOLDS.completed_share * judge.error(old) and agreement(gone) > THRESHOLDS.sure_errors
        )
        plain = far.error(new[1]) < THRESHOLDS.foretold_share * far.error(old) and search.matters(new)
        odd = any(_implausible(search.library, c, new[1]) for c in new[0])
        return halved and plain and not odd and close(judge, new[1], seed, limit)

    alone = _grown(search, ((), search.nothing))
    bases = [(answer.causes, search.fit(answer.causes, None, old.values))] if answer.causes else []
    bases += sorted(alone, key=lambda f: far.error(f[1]))[:1]
    some = [*alone, *(f for base in bases for f in _grown(search, base))]
    # One cause more has to be worth it there, too.
    some.sort(key=lambda f: far.error(f[1]) / THRESHOLDS.foretold_share ** len(f[0]))
    return next((f for f in some if completes(f)), None)


def _grown(search: FittedSets, base: Found) -> list[Found]:
    """The base and one more move, for each of the moves that promise most; all fitted."""
    promised = [s for some in search.promises(base) for s in some[: THRESHOLDS.short_fits]]
    moves = {keys(s.move): s.move for s in promised if not any(search.library.related(c, k) for c in s.move for k in base[0])}
    return [(new, search.fit(new, base)) for new in ((*base[0], *move) for move in moves.values())]


def _told(answer: Answer) -> Answer:
    """Without what differs from the causes, or from one before it, in the form of a law only."""

    def differ(found: Sequence[Found]) -> tuple[Found, ...]:
        seen, kept = {frozenset(c.told for c in answer.causes)}, list[Found]()
        for f in found:
            if (names := frozenset(c.told for c in f[0])) not in seen:
                seen.add(names)
                kept.append(f)
        return tuple(kept)

    return replace(answer, ties=differ(answer.ties), rivals={k: differ(found) for k, found in answer.rivals.items()})


def _refuted(search: FittedSets, causes: Causes, found: Found, later: Windows) -> bool:
    """Is a rough fit, made to the earlier windows, plainly further off on the later ones than what was found?"""
    known = search.known(causes)
    if known is None or not found[1].rough:
        return False
    return fails(judge(known, later), float(judge(found[1], later).chi.max()))


def _richer(search: FittedSets, whole: FittedSets, found: Found, later: Windows) -> Found:
    """With a law in the place of one that it contains, where all windows ask for it and the earlier ones nearly did."""
    for c in found[0]:
        for e in search.library.candidates:
            new = tuple(e if k is c else k for k in found[0])
            if not search.library.within(c, e) or keys(new) == keys(found[0]):
                continue
            known = search.known(new)
            if known is None or search.better(known, found[1]) < -THRESHOLDS.tie_score or _refuted(search, new, found, later):
                continue
            fits = whole.fit_from(new, known), whole.fit_from(*found)
            if whole.better(*fits) > richer(fits, whole.cautious) and whole.matters((new, fits[0])):
                return new, known
    return found


def _simplest(search: FittedSets, found: Sequence[Found]) -> Found:
    """Of sets that explain as much: fewest numbers, plausible ones, a score that is plainly the best, the contract's order."""
    library = search.library
    fewest = min(library.simplicity(s)[0] for s, _ in found)
    best = rank([f for f in found if library.simplicity(f[0])[0] == fewest], search.cautious)
    best = [f for f in best if not any(_implausible(library, c, f[1]) for c in f[0])] or best
    even = [f for f in best if search.better(best[0][1], f[1]) < THRESHOLDS.even_score]
    return min(even, key=lambda f: library.simplicity(f[0]))


def _alternatives(search: FittedSets, whole: FittedSets, found: Found, c: Candidate) -> tuple[Found, ...]:
    """The best sets with something else in the place of c, fitted to all windows; laws that contain c are no rivals of it."""
    rest = without(found[0], (c,))
    base = rest, search.fit(rest, found)
    # What c explains is told beside this fit: from here it has a shorter way than from the fit of all causes.
    whole.fit_from(rest, base[1])
    tried = additions(search, base, instead=c, hope=-np.inf)
    known = {keys(f[0]) for f in tried} | (set() if search.library.measured.exact else search.lost)
    kin = [(s, search.fit(s, base)) for s in _relatives(search, base, c) if keys(s) not in known]
    # Fits to short windows are not compared with those to long ones: the best of each.
    short = bool(tried) and all(keys(s) in search.lost for s, _ in tried)
    groups = [rank(g, search.cautious) for g in ((tried, kin) if short else ([*tried, *kin],))]
    near = [f for g in groups for i, f in enumerate(g) if i == 0 or search.better(found[1], f[1]) < THRESHOLDS.far_rival]
    return tuple(rank([(s, _plainer(whole, found[0], c, s, whole.fit_from(s, f))) for s, f in near], search.cautious))


def _plainer(whole: FittedSets, causes: Causes, c: Candidate, new: Causes, fitted: Fit) -> Fit:
    """The fit of a rival; where c contains it and leaves less, from the numbers of c too: kinks hold up fits from elsewhere."""
    last, (e, *_) = whole.known(causes), without(new, causes)
    told = c.effect.contains.get(e.effect.name) if e.site == c.site else None
    if last is None or not told or whole.better(last, fitted) < THRESHOLDS.richer_score:
        return fitted
    return whole.fit_again(new, (causes, last), whole.carry(c, e, (causes, last), default=False))


def _relatives(search: FittedSets, base: Found, c: Candidate) -> list[Causes]:
    """Laws of the same family, and those that are the same on some data."""
    family, contains, same = c.effect.family, search.library.contains, c.effect.equivalent
    out: dict[tuple[str, str], Causes] = {}
    for promised in search.promises(base, c):
        best = max((s.gain for s in promised), default=0.0)
        for s in promised:
            (e, *more) = s.move
            kin = e.effect.family == family or e.effect.name in same or c.effect.name in e.effect.equivalent
            richer = contains(e.effect.name, c.effect.name)
            if kin and not (richer or more or e.key == c.key) and s.gain > THRESHOLDS.likely_relative * best:
                out[e.key] = (*base[0], e)
    return list(out.values())


def _ties(search: FittedSets, last: Found, rivals: Mapping[tuple[str, str], tuple[Found, ...]]) -> list[Found]:
    """Sets whose score is about the same: a law that contains another, or is contained, is charged for its numbers already."""
    causes, now = last
    out = []
    for key, found in rivals.items():
        (c,) = (k for k in causes if k.key == key)
        for f in found:
            (e,) = without(f[0], causes)
            alone = spared(search, causes, f[0])
            least = richer([now, f[1]], search.cautious, alone) if search.library.related(c, e) else THRESHOLDS.tie_score
            if search.better(now, f[1]) < least:
                out.append(f)
    return out


def _implausible(library: Library, c: Candidate, fitted: Fit) -> dict[str, tuple[float, float]]:
    """The numbers of a cause that lie outside of what is plausible, with its limits."""
    stated = None if (freed := library.freed(c)) is None else freed.value
    if stated == 0:
        return {}
    if unit_slip(library, c, fitted) is not None:
        return {}
    known, scales = fitted.values, library.scales(c)
    limits = {n: (p.plausible[0] * p.scale(scales), p.plausible[1] * p.scale(scales)) for n, p in library.parameters(c).items()}
    if stated is not None and stated < 0:
        limits = {n: (-high, -low) for n, (low, high) in limits.items()}
    own = _own(library.model, c)
    return {n: ends for n, ends in limits.items() if not ends[0] <= known[n] + own <= ends[1]}


def _own(model: Model, c: Candidate) -> float:
    """What an engine has already of the number that a cause adds to: less friction than it has is no negative one."""
    added = len(c.effect.parameters) == 1 and c.effect.parameters[0].off == 0
    native = model.native(*c.key) if added and isinstance(model, EngineModel) else None
    numbers = {p.name: p.value for p in model.backend.parameters} if isinstance(model, EngineModel) and native else {}
    return float(numbers.get(native or "", 0.0))


def unit_slip(library: Library, c: Candidate, fitted: Fit) -> str | None:
    """The two units that a factor of an input or an output confuses, where it is what one of them is of the other."""
    if not library.is_factor(c):
        return None
    value, half = fitted.estimates()[library.names(c)[0]]
    slips = [(abs(abs(value) / slip - 1), slip, units) for units, f in THRESHOLDS.unit_slips for slip in (f, 1 / f)]
    off, slip, units = min(slips)
    near = max(THRESHOLDS.slip_halves * half, THRESHOLDS.sure_slip * slip)
    return units if off < THRESHOLDS.near_slip and off * slip < near else None


def flags(library: Library, c: Candidate, fitted: Fit) -> tuple[str, ...]:
    """Sentences about numbers that are not plausible, or that lie at the edge of what was tried."""
    known, h, out = fitted.values, fitted.hypothesis, list[str]()
    if (units := unit_slip(library, c, fitted)) is not None:
        out.append(f"a slip of units: {c.site} differs by the factor of {units}; is it in the log in the unit of the model?")
    low, high = dict(zip(h.names, h.low, strict=True)), dict(zip(h.names, h.high, strict=True))
    implausible = _implausible(library, c, fitted)
    for i, ((name, p), off) in enumerate(zip(library.parameters(c).items(), library.off(c), strict=True)):
        value, unit = known[name], f" {library.units(c)[i]}".removesuffix(" 1")
        if name in implausible:
            least, most = implausible[name]
            ends = f"below {least:.4g}{unit}" if value < least else f"above {most:.4g}{unit}"
            said = f"implausible: {p.name} = {value:.4g}{unit} is {ends}"
            # A factor that does nothing at 1 (`off`) has no unit: its sign is a convention of the log.
            turned = not p.dimension and p.off == 1.0 and least <= -value <= most
            out.append(f"{said}; is the sign of {c.site} in the log the other way round than in the model?" if turned else said)
        elif min(value - low[name], high[name] - value) < THRESHOLDS.at_bound * (high[name] - low[name]) and value != off:
            least, most = value == low[name], high[name] < p.high * p.scale(library.scales(c))
            said = "as long as the data, which tell no longer one from it" if most else "the most that was tried"
            out.append(f"at the edge: {p.name} = {value:.4g}{unit} is {'the least that was tried' if least else said}")
    return tuple(out)
