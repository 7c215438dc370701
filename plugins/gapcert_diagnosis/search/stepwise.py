"""Which causes: screened, tried on short windows, fitted on long ones, added and dropped while the score pays for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import final

import numpy as np

from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.fitting.fit import Fit, carried, fit
from gapcert_diagnosis.fitting.restarts import rescued

from .candidates import Candidate, Causes, Library
from .criterion import (
    SMALL,
    SURE,
    Found,
    Keys,
    better,
    decides,
    keys,
    lightest,
    margin,
    named,
    noise,
    outdoes,
    pays,
    ranked,
    rough_charge,
    so_far,
    values,
)
from .effect_size import negligible
from .gains import Screened
from .moves import idle, merges, spared, swaps
from .screening import Screen
from .shortlist import FIRST, MORE, finalists, near, plain, replacements, standing_in, stuck, worth

MOST = 3  # moves; more than that are stand-ins for a law that the library lacks
SECOND = 6  # iterations of the longer of two short fits
SHORT = 0.3  # s: windows of the short fits
HOPE = 8.0  # promised fall of the squared residual below which nothing is tried
BY_SHORT, BY_LONG = 8, 4  # candidates that get a short fit
CROWD, ALONE = 100, 0.5  # candidates from which sets are piled up; share that the best of them promises by itself at most
BEAM = 3  # sets that are grown at once while more than noise is left
SHAKES, CLOSE = (0.93, 1.05), 2.0  # restarts of dry laws that are close to the best, but not yet at the noise


@final
class Search:
    """Forward steps, swaps and drops on some windows; every set of causes is fitted once.

    cautious: rough fits are judged by what the windows agree on, not by how many samples they have; thorough: several sets are
    grown at once even where single steps lead to the noise. plain: the fit of nothing, where it is known.
    """

    def __init__(
        self,
        library: Library,
        windows: Windows,
        progress: Callable[..., None] = lambda text, best=None, fitted=True: None,
        plain: Fit | None = None,
    ) -> None:
        self.library, self.windows, self.progress = library, windows, progress
        self.parts = max(1, windows.length // windows.measured.brief(SHORT))
        self._fits: dict[Keys, Found] = {}
        self._brief: dict[Keys, Fit] = {}
        self._promised: dict[tuple[Keys, tuple[str, str] | None], tuple[list[Screened], list[Screened]]] = {}
        self._added: dict[Keys, list[Found]] = {}
        self.cautious = self.thorough = False
        self.piled: Keys | None = None
        self.lost: set[Keys] = set()
        self.negligible: dict[tuple[str, str], float] = {}
        self.nothing = self.fit((), None) if plain is None else self._keep((), rescued(plain, windows))

    @cached_property
    def screen(self) -> Screen:
        return Screen(
            self.library, self.windows, self.nothing, lambda text: self.progress(text, so_far(self._fits), fitted=False)
        )

    @cached_property
    def short(self) -> Windows:
        return self.windows.cut(self.parts)

    def fit(self, causes: Causes, base: Found | None, start: Mapping[str, float] | None = None) -> Fit:
        """On long windows, kept; from `start`, or from `base`, the fit of a set that differs little, and from screening."""
        if keys(causes) not in self._fits:
            self.progress(named(causes), so_far(self._fits))
            self._again(causes, base, start)
        return self._fits[keys(causes)][1]

    def known(self, causes: Causes) -> Fit | None:
        """The fit of a set, if it was ever made."""
        return self._fits[keys(causes)][1] if keys(causes) in self._fits else None

    def _again(self, causes: Causes, base: Found | None, start: Mapping[str, float] | None = None) -> Fit:
        """A fit from other first values; the better one is kept."""
        h = self.library.hypothesis(causes)
        known = dict(zip(h.names, h.value.tolist(), strict=True))
        if base is not None:
            known |= values(base[1]) | (self._first(causes, base) if start is None else {})
        known |= start or {}
        theta = np.array([known[n] for n in h.names])
        fewer = base is not None and keys(causes) < keys(base[0]) and len(base[1].start) == len(self.windows)
        new = fit(h, self.windows, theta=theta, start=base[1].start if base and fewer else None)
        return self._keep(causes, rescued(new, self.windows))

    def moved(self, causes: Causes, other: Fit) -> Fit:
        """The fit of a set from its numbers on other windows; starts that are not known from there follow these first."""
        if keys(causes) not in self._fits:
            h = self.library.hypothesis(causes)
            theta = np.array([values(other)[n] for n in h.names])
            closest = min((f for _, f in self._fits.values()), key=lambda f: float(f.chi.sum()))
            start = carried(h, theta, other, self.windows, closest.start)
            self._keep(causes, rescued(fit(h, self.windows, theta=theta, start=start), self.windows))
        return self._fits[keys(causes)][1]

    def _keep(self, causes: Causes, new: Fit) -> Fit:
        old = self._fits.get(keys(causes))
        if old is None or self.better(new, old[1]) > 0:
            self._fits[keys(causes)] = causes, new
        return self._fits[keys(causes)][1]

    def _first(self, causes: Causes, base: Found) -> dict[str, float]:
        """What screening promises for the causes that the base lacks."""
        out: dict[str, float] = {}
        for c in causes:
            if c.key not in keys(base[0]):
                found = self.promise(base, c) or self.promise(((), self.nothing), c)
                names = self.library.names(c)
                out |= found.values if found else dict(zip(names, self.library.starts(c)[0].tolist(), strict=True))
        return out

    def promise(self, base: Found, c: Candidate) -> Screened | None:
        known = [p for (k, instead), p in self._promised.items() if k == keys(base[0]) and instead]
        found = [s for short, long in known for s in (*long, *short) if keys(s.move) == {c.key}]
        if not (found or base[0]) and len(self.library.candidates) >= CROWD:
            # The pile has entered all of them.
            found = [s for s in (self.screen.promise(self.brief(base), self.parts, c),) if s is not None]
        elif not found:
            short, long = self.promised(base)
            found = [s for s in (*long, *short) if keys(s.move) == {c.key}]
        return found[0] if found else None

    def promised(self, base: Found, instead: Candidate | None = None) -> tuple[list[Screened], list[Screened]]:
        """All moves by their promise on short and on long windows; of very many those that could stand for `instead`."""
        key = keys(base[0]), None if instead is None or len(self.library.candidates) < CROWD else instead.key
        if key not in self._promised:
            moves = [m for m in self.library.moves if not keys(m) & key[0]]
            if key[1] is not None:
                moves = standing_in(moves, self.screen.beside(self.brief(((), self.nothing)), self.parts, base[0]), key[1])
            long, short = self.screen.ranked([(base[1], 1), (self.brief(base), self.parts)], moves)
            self._promised[key] = short, long
        return self._promised[key]

    def brief(self, base: Found) -> Fit:
        """The set of a long fit, fitted to the short windows."""
        key = keys(base[0])
        if key not in self._brief:
            self._brief[key] = fit(base[1].hypothesis, self.short, theta=base[1].theta, iterations=FIRST)
        return self._brief[key]

    def settled(self, causes: Causes, base: Found) -> Fit:
        """The best of a fit and of fresh ones from nearby: sticking puts kinks into the cost, and a fit may catch on one."""
        best, dry = self.fit(causes, base), self.library.dry(causes)
        for factor in SHAKES if dry and not noise(best) else ():
            shaken = {n: v * factor if n in dry else v for n, v in values(best).items()}
            self._again(causes, None, shaken)
        return self._fits[keys(causes)][1]

    def additions(self, causes: Causes, base: Found, instead: Candidate | None = None, hope: float = HOPE) -> list[Found]:
        """Fits of `causes` with one move more, best first; none where screening promises nothing.

        instead: of this cause; where nothing comes near it, the best on short windows.
        """
        if keys(causes) in self._added:
            new = [(f, tuple(c for c in f[0] if c.key not in keys(causes))) for f in self._added[keys(causes)]]
            return ranked([f for f, move in new if self._allowed(move, causes, instead)], self.cautious)
        short, long = (
            worth([s for s in p if self._allowed(s.move, causes, instead)], p, instead) for p in self.promised(base, instead)
        )
        least = hope + 2 * math.log(max(1, len(self.library.candidates)))
        if max((p[0].gain for p in (short, long) if p), default=-math.inf) < least:
            return []
        picks = {keys(s.move): s for s in plain([*long[:BY_LONG], *short[:BY_SHORT]], self.library)}
        blind = [s for s in stuck(self, causes, picks) if self._allowed(s.move, causes, instead)]
        known = None if instead is None else self.known((*causes, instead))
        if instead is None or known is None:
            tried = [(s, self.tried(causes, base, s)) for s in (*picks.values(), *blind)]
        else:
            own = self.brief(((*causes, instead), known))
            tried = near(replacements(self, [*picks.values(), *blind], base, instead, own), own, self.cautious)
            if all(keys((*causes, *s.move)) in self.lost for s, _ in tried):
                return [((*causes, *s.move), f) for s, f in tried]
        if not tried:
            return []
        full: list[Found] = []
        for s, first in finalists(tried, [keys(s.move) for s in long[:MORE]], self.cautious):
            grown = (*causes, *s.move)
            second = fit(first.hypothesis, self.short, theta=first.theta, start=first.start, iterations=SECOND)
            full.append((grown, self.fit(grown, base, values(second))))
        full = ranked(full, self.cautious)
        least = (full[0][1] if known is None else known).chi.sum()
        close = [s for s, f in full if f.chi.sum() < CLOSE * least]
        full = ranked([(s, self.settled(s, (s, f)) if s in close else f) for s, f in full], self.cautious)
        if instead is None:
            self._added[keys(causes)] = full
        return full

    def _allowed(self, move: Causes, causes: Causes, instead: Candidate | None) -> bool:
        """Not twice the same law at one site: a law that contains another takes its place, not a place beside it."""
        contains = self.library.contains
        if instead and (len(move) > 1 or move[0].key == instead.key or contains(move[0].effect.name, instead.effect.name)):
            return False
        return not any(self.library.related(c, k) for c in move for k in causes)

    def tried(self, causes: Causes, base: Found, s: Screened, iterations: int = FIRST) -> Fit:
        h, brief = self.library.hypothesis((*causes, *s.move)), self.brief(base)
        known = dict(zip(h.names, h.value.tolist(), strict=True)) | values(brief) | dict(s.values)
        theta = np.array([known[n] for n in h.names])
        return fit(h, self.short, theta=theta, start=brief.start, iterations=iterations)

    def better(self, new: Fit, old: Fit) -> float:
        return better(new, old, self.cautious)

    def found(self) -> Found:
        """What forward steps lead to; cautious ones, where something else is plainly missing, unless they miss plainly more."""
        best = self.forward()
        if best[1].rough:
            self.cautious = True
            first, best = self.refined(best), self.forward()
            most = max(1, len(first[0]) - len(best[0])) * self.library.threshold
            best = first if self.better(first[1], best[1]) > most and self.matters(first) else best
        return best

    def forward(self) -> Found:
        """What single steps lead to; where that is no noise yet, or does not last, the best of what several at once lead to."""
        if not self.thorough and (few := self._pursued()) is not None:
            return few
        best = self._forward(1)
        if not best[0] or (noise(best[1]) and not self.thorough):
            return best
        small, large = sorted([best, self._forward(BEAM)], key=lambda f: len(f[0]))
        return large if self.outdoes(large, small) else small

    def _pursued(self) -> Found | None:
        """Of very many candidates a few that screening piles up, if they leave noise, and no single one promises much of it."""
        if len(self.library.candidates) < CROWD:
            return None
        base: Found = ((), self.nothing)
        for sets, gains in self.screen.pursued([(self.brief(base), self.parts), (self.nothing, 1)], MOST):
            if gains and gains[0] < ALONE * gains[-1]:
                grown = sets[-1].move
                new = self.refined((grown, self.fit(grown, base, values(self.tried((), base, sets[-1])))))
                if noise(new[1], SURE) and self.pays(new, base) and self.matters(new):
                    self.piled = keys(new[0])
                    return new
        return None

    def _forward(self, width: int) -> Found:
        """Add the best move while it pays; after each, swap and drop. width: sets that are grown at once."""
        best: Found = ((), self.nothing)
        beam = [best]
        for _ in range(MOST):
            grown: dict[Keys, Found] = {}
            for parent in beam:
                tried = [self._lighter(f, parent) for f in self.additions(parent[0], parent) if self.pays(f, parent)]
                paying = [f for f in tried if self.pays(f, parent) and self.matters(f)]
                for f in paying[:width]:
                    refined = self.refined(f)
                    grown[keys(refined[0])] = refined
            new = [f for f in ranked(list(grown.values()), self.cautious) if keys(f[0]) != keys(best[0])]
            if not new or not self.outdoes(new[0], best):
                break
            best = new[0]
            beam = new[: 1 if noise(best[1]) and not self.thorough else width]
        return best

    def _lighter(self, found: Found, parent: Found) -> Found:
        """Without what is negligible: members of the move, where others of it are not, and what it took the place of."""
        small = {s[:2] for s in negligible(self.screen, found[0], values(found[1]))}
        small = {k for k in small if k not in keys(parent[0]) or not self._decides(found, k)}
        rest = tuple(c for c in found[0] if c.key not in small)
        if not small or keys(rest) <= keys(parent[0]):
            return found
        return rest, self.fit(rest, parent, values(found[1]))

    def refined(self, found: Found) -> Found:
        """Drops, swaps for simpler and richer laws and merges, until none of them pays."""
        found = self._pruned(found)
        seen = {keys(found[0])}
        while keys((new := self._simpler(found))[0]) not in seen:
            found = new
            seen.add(keys(found[0]))
        return found

    def _pruned(self, found: Found) -> Found:
        """Without all causes at once that the fit, to second order, loses little without; with half of these, where it does."""
        causes, now = found
        order, lost = lightest(self.library, causes, now)
        small = order[: int(np.searchsorted(lost, SMALL))]
        while len(small) > 1:
            rest = tuple(c for c in causes if c not in small)
            if rest and not self.pays(found, (rest, without := self.fit(rest, found))):
                return self._pruned((rest, without))
            small = small[: len(small) // 2]
        return found

    def _simpler(self, found: Found) -> Found:
        causes, now = found
        for c in causes:
            rest = tuple(k for k in causes if k is not c)
            grown = len(rest) > 1 and self.known(rest) is not None
            without = self.fit(rest, found)
            if grown:
                # What was grown step by step may sit in a valley that only the larger set leads out of.
                without = self._again(rest, None, values(now))
            if not self.pays(found, (rest, without)):
                return rest, without
        options = [*swaps(self, found), *merges(self, found)]
        for new, start in sorted(options, key=lambda o: self.library.simplicity(o[0])[0]):
            if idle(self, found, new):
                continue
            fitted = self.fit(new, found, start)
            more = self.library.simplicity(new)[0] - self.library.simplicity(causes)[0]
            merged, alone = len(new) < len(causes), spared(self, causes, new)
            least = margin([fitted, now], more, self.cautious, merged=merged, spared=alone)
            if self.better(fitted, now) > least and self.matters((new, fitted)):
                return new, fitted
        return found

    def carried(self, old: Candidate, new: Candidate, found: Found, default: bool = True) -> dict[str, float]:
        """First values of one law from those of another that it contains, or that contains it."""
        fitted = values(found[1])
        mine = dict(zip((p.name for p in new.effect.parameters), self.library.names(new), strict=True))
        theirs = dict(zip((p.name for p in old.effect.parameters), self.library.names(old), strict=True))
        out: dict[str, float] = self._first((new,), ((), self.nothing)) if default else {}
        for m, t in new.effect.contains.get(old.effect.name, {}).items():
            out[mine[m]] = fitted[theirs[t]]
        for t, m in old.effect.contains.get(new.effect.name, {}).items():
            out[mine[m]] = fitted[theirs[t]]
        return out

    def pays(self, found: Found, before: Found) -> bool:
        return pays(found[1], before[1], *self._charges(found, before))

    def outdoes(self, new: Found, best: Found) -> bool:
        return outdoes(new[1], best[1], *self._charges(new, best), larger=len(new[0]) > len(best[0]))

    def _charges(self, found: Found, before: Found) -> tuple[float, float | None]:
        """What a larger set must bring: where samples are counted, and where a cautious search finds both fits rough."""
        return self.library.threshold, rough_charge(self.library, found[0], before[0]) if self.cautious else None

    def matters(self, found: Found) -> bool:
        """Is every cause larger than what an integrator may leave, or than a stated tolerance? What is not, is noted.

        Where almost nothing rubs, a thousandth of the effort may be all that is wrong: then it decides what windows look like.
        """
        small = [s for s in negligible(self.screen, found[0], values(found[1])) if not self._decides(found, s[:2])]
        self.negligible |= {(effect, site): share for effect, site, share in small}
        return not small

    def _decides(self, found: Found, key: tuple[str, str]) -> bool:
        return decides(found[1], self.fit(tuple(c for c in found[0] if c.key != key), found))
