"""Which settings would close the difference between two backends: candidates, each verified by changing it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

from pydantic import BaseModel

from gapcert_compare.thresholds import THRESHOLDS
from gapcert_engines import Options, declared, flat, plain, short

from .laboratory import Peer


@final
@dataclass(frozen=True)
class Change:
    """One setting of one backend, and the options that it changes: path → new value.

    natives: native parameters that it sets instead; told: what a diagnosis says of it (`effect`, `site`, `native`,
    `parameters`), with `value` and `was` where no option makes it.
    """

    on: str
    setting: str
    options: Options
    was: Options
    natives: Mapping[str, float] = field(default_factory=dict)
    told: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        if not self.options:
            return json.dumps([self.on, self.setting, sorted(self.natives.items())])
        return json.dumps([self.on, sorted(self.options.items())], default=str)

    def clashes(self, others: Sequence[Change]) -> bool:
        """Whether one of the others already sets one of its options."""
        return any(self.on == o.on and self.options.keys() & o.options.keys() for o in others)

    def summary(self) -> dict[str, Any]:
        return {
            "on": self.on,
            "setting": self.setting,
            "value": short(self.options) if self.options else None,
            "was": short(self.was) if self.options else None,
            "options": {k: plain(v) for k, v in self.options.items()},
            **self.told,
        }


def candidates(peer: Peer, other: Peer) -> list[Change]:
    """What may be changed on one backend: what it declares, then what its partner has otherwise, then its defaults."""
    have, theirs = flat(peer.config), flat(other.config)
    fields = type(peer.config).model_fields if isinstance(peer.config, BaseModel) else {}
    defaults = {k: f.get_default(call_default_factory=True) for k, f in fields.items() if k in have and not f.is_required()}
    found = declared(peer.config)
    for name, options in list(found):
        if len(options) > 1 and options.keys() <= theirs.keys():
            found.append((name, {k: theirs[k] for k in options}))
    found += [(k, {k: v}) for source in (theirs, defaults) for k, v in source.items() if k in have]
    out: dict[str, Change] = {}
    for name, options in found:
        new = {k: v for k, v in options.items() if plain(v) != plain(have.get(k))}
        if new:
            change = Change(peer.name, name, new, {k: have.get(k) for k in new})
            out.setdefault(change.key, change)
    return list(out.values())


@final
@dataclass(frozen=True)
class Trial:
    """Changes, the mean difference that is left with them, and whether it is within both resolutions.

    made: whether the backend was told them, or else the equations of its bodies; named: by a diagnosis.
    """

    changes: tuple[Change, ...]
    mean: float
    closes: bool
    made: bool = True
    named: bool = False

    @property
    def size(self) -> int:
        """How much it asks for: another robot is no setting, and comes after all of them."""
        return sum(2 * THRESHOLDS.joint_changes if "robot" in c.options else 1 for c in self.changes)

    def done(self, before: float) -> bool:
        """Does it close the difference, or leave nothing of it but the rounding of fitted numbers?"""
        return self.closes or self.mean <= THRESHOLDS.nothing_left * before

    def summary(self, before: float) -> dict[str, Any]:
        """One entry of `explained_by`: reduction = 1 − mean after / mean before."""
        reduction = 1 - self.mean / before
        if len(self.changes) == 1:
            return {**self.changes[0].summary(), "reduction": reduction, "closes": self.closes, "made": self.made}
        parts = [c.summary() for c in self.changes]
        sided = len({p["setting"] for p in parts}) < len(parts)
        names = [f"{p['on']}.{p['setting']}" if sided else p["setting"] for p in parts]
        value = {name: p["value"] for name, p in zip(names, parts, strict=True)}
        together = {"setting": " + ".join(names), "value": value, "changes": parts}
        return {**together, "reduction": reduction, "closes": self.closes, "made": self.made}


Attempt = Callable[[tuple[Change, ...]], Trial | None]
Diagnose = Callable[[Sequence[Trial]], Sequence[Trial]]
"""Single changes that lower the difference → what a diagnosis names."""


def explain(
    changes: Sequence[Change], attempt: Attempt, before: float, least: float, noise: float, diagnose: Diagnose | None = None
) -> list[dict[str, Any]]:
    """The changes that lower the mean difference by at least the share `least`, and by more than `noise`; best first.

    Where some close it, these are all that is named. Where none does alone, what was diagnosed stands beside its parts, or,
    where that is not enough, changes are added one by one to the best few, while the mean goes on falling.
    """

    def counts(trial: Trial, mean: float) -> bool:
        return mean - trial.mean > max(least * mean, noise)

    single = [t for c in changes if (t := attempt((c,))) is not None and counts(t, before)]
    diagnosed = [t for t in (diagnose(single) if diagnose else ()) if counts(t, before)]
    known = {t.changes[0].key for t in diagnosed if len(t.changes) == 1}
    single = [t for t in single if t.changes[0].key not in known]
    done = [t for t in diagnosed if t.done(before)]
    # What one of the two can be told needs no stand-in in the equations of the other.
    told = [*done, *(t for t in single if t.closes)]
    named = [t for t in told if t.made] or told
    if done and not any(len(t.changes) == 1 for t in named):
        parts = (attempt((c,)) for c in min(done, key=lambda t: t.size).changes if c.options or c.natives)
        named += [t for t in parts if t is not None and counts(t, before)]
    elif not named and (single or diagnosed):
        single += [t for t in diagnosed if len(t.changes) == 1 and t.made]
        together = _together(sorted(single, key=_rank), changes, attempt, counts) if single else None
        if together is not None and together.closes:
            keys = {c.key for c in together.changes}
            single = [t for t in single if t.changes[0].key in keys]
        named = [*([together] if together else []), *(t for t in diagnosed if t not in single), *single]
    return [t.summary(before) for t in sorted(named, key=lambda t: _order(t, before))[: THRESHOLDS.listed_changes]]


def _rank(trial: Trial) -> tuple[bool, float, int]:
    # Two that close the difference are equally good, whatever rounding leaves: the one with fewer changes first.
    return not trial.closes, 0.0 if trial.closes else trial.mean, trial.size


def _order(trial: Trial, before: float) -> tuple[Any, ...]:
    """Of what leaves nothing: fewer changes first, then what a diagnosis named, then what the backend was told."""
    if trial.done(before):
        return False, trial.size, not trial.named, not trial.made, _rank(trial)
    return True, _rank(trial)


def _together(
    ranked: Sequence[Trial], changes: Sequence[Change], attempt: Attempt, counts: Callable[[Trial, float], bool]
) -> Trial | None:
    """The best combination that improves on every single change, or None."""
    best = ranked[0]
    beam = list(ranked[: THRESHOLDS.beam])
    for _ in range(THRESHOLDS.joint_changes - 1):
        seen: dict[frozenset[str], Trial] = {}
        for start in beam:
            for c in changes:
                keys = frozenset([c.key, *(one.key for one in start.changes)])
                if keys in seen or c.clashes(start.changes):
                    continue
                if (t := attempt((*start.changes, c))) is not None and counts(t, start.mean):
                    seen[keys] = t
        beam = sorted(seen.values(), key=_rank)[: THRESHOLDS.beam]
        if not beam or not (beam[0].closes or counts(beam[0], best.mean)):
            break
        best = beam[0]
        if best.closes:
            break
    return best if len(best.changes) > 1 else None
