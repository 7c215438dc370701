"""Screening: what every candidate would do to the residual of a fit, by the linearised motion along the measured path.

A candidate's push is the one-step difference that it makes from every state of the measured, smoothed path, its memories
carried along that path. Pushes go through x_{k+1} = A_k x_k + d_k to the measured channels; what the starts of the windows
and the numbers that are free already can make of the residual is projected out, the prior counted as data.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Windows, flat, once
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.fitting.linearised import Motion, Path, sliding, velocity
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_figures import called

from .candidates import Candidate, Causes, Library
from .gains import GainTable, Promise, Push

ROWS = 512  # motions that are stepped together: more no longer stay near the processor


@final
class Screen:
    """Pushes of all candidates on some windows, made once: how large these are, what they promise for the fit of any set."""

    def __init__(self, library: Library, windows: Windows, guess: Fit, tell: Callable[[str], None] = lambda text: None) -> None:
        self.tell = tell
        few = max(1, THRESHOLDS.screened_samples // windows.length)
        rows = np.arange(len(windows))
        if len(rows) > few:
            rows = np.unique(np.linspace(0, len(windows) - 1, few).astype(int))
        self.library, self.rows, self.windows = library, rows, windows.take(rows)
        self.path = Path(self.windows, guess, guess.start[rows])
        self._pushes: dict[tuple[str, str], Push] = {}
        self._made: dict[object, Any] = {}

    def once(self, key: object, make: Callable[[], Any]) -> Any:
        """What is made for these windows, made the first time."""
        return once(self._made, key, make)

    def _shown(self, model: Model) -> Array:
        """Outputs (W, L, ny) along the path of a model whose extensions are off."""
        return np.asarray(self.once(("shown", id(model)), lambda: self.path.output(model, {})))

    def push(self, c: Candidate) -> Push:
        if c.key not in self._pushes:
            self.tell(f"screening {called(*c.told)}")
            self._pushes[c.key] = self.pushed(c, _distinct(self.library.starts(c), self.library.amplitude(c)))
        return self._pushes[c.key]

    def _at_once(self, candidates: Sequence[Candidate]) -> None:
        """Pushes of each law at all of its sites in one pass: a pass costs about as much for a few rows as for many."""
        new = [c for c in candidates if c.key not in self._pushes and self._moving(c)]
        for _, group in itertools.groupby(new, key=lambda c: c.effect.name):
            members = tuple(group)
            values = [_distinct(self.library.starts(c), self.library.amplitude(c)) for c in members]
            ends = np.cumsum([0, *map(len, values)])
            if len(members) < 2 or not ends[-1]:
                continue
            given: dict[str, Array] = {}
            for c, rows, first in zip(members, values, ends, strict=False):
                for name, off, column in zip(self.library.names(c), self.library.off(c), rows.T, strict=True):
                    given[name] = np.full(int(ends[-1]), off)
                    given[name][first : first + len(rows)] = column
            fine = any(map(self.library.suggested, members))
            state = self._moved(self.library.shared(members[0]), given, int(ends[-1]), fine=fine)
            for c, rows, first in zip(members, values, ends, strict=False):
                own = np.ascontiguousarray(state[..., first : first + len(rows)])
                self._pushes[c.key] = Push(c, rows, own, self._fed(c, rows))

    def _moving(self, c: Candidate) -> bool:
        """Does a candidate change the next state, and not what is shown of it, or a stated number?"""
        e = self.library.extension(c)
        return e.output is None and e.output_delay is None and self.library.loosened(c) is None

    def _moved(self, model: Model, given: Mapping[str, Array], count: int, *, fine: bool) -> Array:
        """What parameters add to one step along the path, (W, S, nx, count); fine: which may change from sample to sample."""
        m, (w, steps, nx) = self.windows.measured, self.path.x[:, self.path.lead :].shape
        every = 1 if fine or m.exact or model.hidden else m.repeat * max(1, round(THRESHOLDS.screening_block / m.period))
        moved, some, off = np.empty((w, steps, nx, count)), max(1, ROWS // w), ("off", id(model), every)
        for k in range(0, count, some):
            part = {n: v[k : k + some] for n, v in given.items()}
            new = off not in self._made
            if new:
                # The first motion is that of the model whose extensions are off.
                stated = {p.name: p.value for p in model.parameters}
                part = {n: np.concatenate([[stated[n]], v]) for n, v in part.items()}
            found = self.path.next(model, part, int(new) + len(range(k, min(k + some, count))), every=every)
            if new:
                self._made[off] = found[0]
            added = difference(self.library.model.states, found[int(new) :], self._made[off])
            # What is averaged over blocks need not be known at each of their samples.
            moved[..., k : k + some] = np.moveaxis(np.repeat(added, every, axis=2)[:, :, :steps], 0, -1)
        return moved

    def pushed(self, c: Candidate, values: Array, like: Candidate | None = None) -> Push:
        """The differences that values (g, p) of a candidate's parameters make along the path, in the steps of another one."""
        names = self.library.names(c)
        if self.library.loosened(c) is not None:
            return Push(c, values, None, None)
        model = self.library.shared(c)
        if not self._moving(c):
            return Push(c, values, None, self._added(c, values))
        fine = bool(self.library.suggested(like or c))
        state = self._moved(model, dict(zip(names, values.T, strict=True)), len(values), fine=fine)
        return Push(c, values, np.ascontiguousarray(state), self._fed(c, values))

    def _fed(self, c: Candidate, values: Array) -> Array | None:
        """What a change of an input adds to the channels at once, where they show that input."""
        return self._added(c, values) if c.effect.site == "input" and self.library.shows(c.site) else None

    def _added(self, c: Candidate, values: Array) -> Array:
        """What values (g, p) add to the channels along the path, (W, L, ny, g)."""
        model, names, channels = self.library.shared(c), self.library.names(c), self.windows.measured.channels
        shown = [self.path.output(model, dict(zip(names, row, strict=True))) for row in values.tolist()]
        return np.stack([difference(channels, y, self._shown(model)) for y in shown], axis=-1)

    def push_at(self, c: Candidate, values: Mapping[str, float], like: Candidate | None = None) -> Push:
        return self.pushed(c, np.array([[values[n] for n in self.library.names(c)]]), like)

    def silent(self, c: Candidate, values: Mapping[str, float], before: float) -> bool:
        """Does a cause do nothing in the windows that begin before a time?"""
        push = self.push_at(c, values)
        early = self.windows.t < before
        return push.state is not None and bool(np.any(push.state)) and not np.any(push.state[early])

    def share(self, c: Candidate, values: Mapping[str, float]) -> float:
        """Root mean square of what a cause does in the window where it does most, over that of the effort at its site.

        Of a parameter: infinite where it is outside of its tolerance, else zero; without one, how much of its scale it moved.
        """
        library, m = self.library, self.windows.measured
        if (doubt := library.doubted(c)) is not None:
            return abs(values[library.names(c)[0]] - library.off(c)[0]) / doubt
        if (freed := library.freed(c)) is not None:
            return math.inf if abs(values[freed.name] - freed.value) > freed.tolerance else 0.0
        push = self.push_at(c, values)
        if push.output is not None and push.state is None:
            channel = [s.name for s in m.channels].index(c.site)
            return _most(push.output[:, :, channel]) / float(m.spread[channel])
        assert push.state is not None, "what frees no number moves the state or the output"
        moved = push.state[..., 0]
        if c.effect.site == "coordinate":
            return _most(self._force(c, moved)) / library.scales(c)["force"]
        column, effort = self.once(("felt", c.site), lambda: self._felt(c))
        return _most(moved[..., column]) / float(effort)

    def adds(self, c: Candidate, values: Mapping[str, float], simpler: Candidate) -> float:
        """What a law does to the state beyond one that it contains, as a share of what it does."""
        mine, theirs = ({p.name: n for n, p in self.library.parameters(k).items()} for k in (c, simpler))
        known = {theirs[t]: values[mine[m]] for m, t in c.effect.contains[simpler.effect.name].items()}
        whole, part = self.push_at(c, values, simpler).state, self.push_at(simpler, known).state
        if whole is None or part is None:
            return 1.0
        return _most(whole - part) / max(_most(whole), 1e-300)

    def _force(self, c: Candidate, moved: Array) -> Array:
        """The force at a coordinate that makes one-step differences (W, S, nx)."""
        response = self.once(("sliding", c.site), lambda: sliding(self.library.model, c.site, *self._states()))
        v = velocity(self.library.model, c.site, response)
        return np.asarray(moved[..., v] / response[:, v].reshape(moved.shape[:2]))

    def _felt(self, c: Candidate) -> tuple[int, float]:
        """(column, root mean square) of what the input at the site does to the state in one step, where it does most."""
        model, (x, u) = self.library.model, self._states()
        without = np.where([s.name == c.site for s in model.inputs], 0.0, u)
        pushed = difference(model.states, model.step(x, u).x, model.step(x, without).x)
        sizes = np.sqrt(np.mean(pushed**2, axis=0))
        most = int(np.argmax(sizes / (np.std(x, axis=0) + 1e-300)))
        return most, float(sizes[most]) or 1e-300

    def _states(self) -> tuple[Array, Array]:
        """States and inputs (W·S, ·) of the path, without history."""
        return flat(self.path.x[:, self.path.lead :]), flat(self.path.u[:, self.path.lead :])

    def rank(self, fits: Sequence[tuple[Fit, int]], moves: Sequence[Causes]) -> list[list[Promise]]:
        """Per fit, whose windows are these cut into so many parts, the moves by their promise, best first."""
        out = []
        for table in self.tables(fits, dict.fromkeys(c for move in moves for c in move)):
            found = _sorted(table, moves)
            best = [s.move for s in found[: THRESHOLDS.scanned_moves]]
            self._scan(table, dict.fromkeys(c for move in best for c in move))
            out.append(_sorted(table, best) + found[THRESHOLDS.scanned_moves :])
        return out

    def tables(self, fits: Sequence[tuple[Fit, int]], candidates: Collection[Candidate] | None = None) -> Iterator[GainTable]:
        """Per fit as in `rank` the gains of candidates, by default of all; of a fit without causes they are kept."""
        motion = Motion.of(self.path, fits[0][0])
        for fit, parts in fits:
            make = functools.partial(GainTable, self.library, self.windows, self.rows, motion, fit, parts)
            table: GainTable = make() if fit.hypothesis.charged else self.once(("gains", id(fit), parts), make)
            new = [c for c in (self.library.candidates if candidates is None else candidates) if c.key not in table.entered]
            self._at_once(new)
            table.enter([self.push(c) for c in new])
            yield table

    def _scan(self, table: GainTable, candidates: Iterable[Candidate]) -> None:
        """Needles: more values about the best of many."""
        for c in candidates:
            if c.key in table.columns:
                finer = _between(table.columns[c.key].values, table.best(c), self.library.amplitude(c))
                if len(finer):
                    table.enter([self.pushed(c, finer)])


def standing_in(moves: Sequence[Causes], gains: Mapping[tuple[str, str], float], cause: tuple[str, str]) -> list[Causes]:
    """Single moves that promise some of what a cause does, the best few in any case, and the cause itself.

    Those without a column, which lift the tolerance of a number that is free already, cost nothing to ask.
    """
    best = sorted(gains, key=lambda k: -gains[k])[: THRESHOLDS.loose_rivals]
    near = {k for k, gain in gains.items() if gain > THRESHOLDS.loose_promise * gains.get(cause, 0.0)}
    kept = {*near, *best, cause}
    return [m for m in moves if len(m) == 1 and (m[0].key in kept or m[0].key not in gains)]


def _sorted(table: GainTable, moves: Sequence[Causes]) -> list[Promise]:
    return sorted((s for move in moves if (s := table.promise(move)) is not None), key=lambda s: -s.gain)


def _distinct(values: Array, amplitude: int | None) -> Array:
    """Starts that differ in more than the number that the effect is linear in: its gain is found, not tried."""
    if amplitude is None or len(values) == 0:
        return values
    rest = np.delete(values, amplitude, axis=1)
    _, first = np.unique(rest, axis=0, return_index=True)
    return np.asarray(values[np.sort(first)])


def _between(values: Array, best: Array, amplitude: int | None) -> Array:
    """Points about the best of many values of one number, where an effect is a needle; none where there are few values."""
    rest = [k for k in range(values.shape[1]) if k != amplitude and len(np.unique(values[:, k])) >= THRESHOLDS.scanned_starts]
    if len(rest) != 1:
        return values[:0]
    (k,) = rest
    known = np.unique(values[:, k])
    at = int(np.searchsorted(known, best[k]))
    out = np.tile(best, (THRESHOLDS.finer_scan, 1))
    out[:, k] = np.linspace(known[max(at - 1, 0)], known[min(at + 1, len(known) - 1)], THRESHOLDS.finer_scan + 2)[1:-1]
    return out


def _most(a: Array) -> float:
    """The largest root mean square of a window."""
    return float(np.sqrt(np.mean(a.reshape(len(a), -1) ** 2, axis=1).max()))
