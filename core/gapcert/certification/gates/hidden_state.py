"""The hidden-state gate: does f̂ depend on engine state outside (x, u), and what is done about it?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np

from gapcert.certification.gates.augment import Augmented
from gapcert.certification.gates.hidden_distribution import (
    Around,
    HiddenDraws,
    Law,
    Pool,
    Range,
    Ranges,
    Visited,
    change,
    columns,
    inputs,
    moved,
    visited,
)
from gapcert.certification.ledger import Entry
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.plugins.events import Emit, Pulse, silent
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

Mode = Literal["refuse", "augment", "default", "sample"]


_BLOCK = 64  # rows of an attack between two signs of life


@final
@dataclass(frozen=True)
class HiddenPlan:
    """What to do where hidden state matters.

    `refuse`; `augment`: those that the domain names become states; `default`: certify the declared default, and attack that
    certificate with others; `sample`: draw and bound over `ranges`, or over the `near` nearest of the states that `runs`
    rollouts of `steps` visit; `safety` multiplies the measured spread. Axes in `ignore` do not count for nearness.
    """

    mode: Mode = "refuse"
    ranges: Mapping[str, Range] = field(default_factory=dict)
    runs: int = 50
    steps: int = 20
    near: int = 8
    safety: float = 1.5
    ignore: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class Probe:
    """|f̂(x, u, h) − f̂(x, u, h₀)|, largest per state: `each` (nh, nx), one hidden state moved alone; `together` (nx,), all
    moved at once; `met` (nx,), as visited in rollouts. `gap` (nx,) is the mean |r| with h₀, `e` the resolution.

    `witness`: x, u, h, x⁺ with h₀ and x⁺ with h, where the largest difference beside the mean gap was seen.
    """

    names: tuple[str, ...]
    each: Array
    together: Array
    met: Array
    gap: Array
    e: Array
    witness: Mapping[str, list[float]]
    queries: int

    @property
    def spread(self) -> Array:
        """(nx,): the largest of all differences."""
        return np.asarray(np.vstack([self.each, self.together, self.met]).max(axis=0))

    @property
    def harmless(self) -> bool:
        return bool((self.spread <= THRESHOLDS.harmless * self.e).all())

    def ranked(self) -> list[tuple[str, Array]]:
        """Hidden states that matter alone, the one with the largest spread beside the mean gap first."""
        beside = (self.each / np.maximum(self.gap, self.e)).max(axis=1)
        order = np.argsort(-beside, kind="stable")
        return [(self.names[k], self.each[k]) for k in order if (self.each[k] > THRESHOLDS.harmless * self.e).any()]


@final
@dataclass(frozen=True)
class Gate:
    """What the gates found: `purity` and `turns` in words, `warnings`, and the branch that was taken with hidden state.

    `system` is what is sampled, `bound` (nx,) the spread that acts as further resolution; it cost `spent` transitions.
    `audited`, if set, is asked by the audit instead: hidden state that a probe found harmless is drawn there all the same.
    `first`: see `purity.answered`; `jitter`: see `entry.jitter`, none of noise that is drawn.
    """

    plan: HiddenPlan
    system: System
    states: tuple[str, ...]
    names: tuple[str, ...]
    bound: Array
    probe: Probe | None = None
    law: Law | None = None
    purity: str = ""
    turns: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    spent: int = 0
    attack: Mapping[str, Any] = field(default_factory=dict)
    audited: System | None = None
    first: Any = None
    jitter: Array | None = None

    @property
    def distribution(self) -> str:
        """What the audit's distribution says of the hidden state; empty where there is none."""
        law = self.audited.law if isinstance(self.audited, HiddenDraws) else self.law
        if law is not None:
            return f", hidden state {law.describe()}"
        return ", hidden state at its default" if self.probe is not None and not self.probe.harmless else ""

    def summary(self) -> dict[str, Any]:
        """The `certificate.hidden` object of the JSON contract; empty for systems that never had hidden state."""
        if self.probe is None and not self.names:
            return {}
        p = self.probe
        out: dict[str, Any] = {
            "mode": self.plan.mode,
            "names": list(self.names),
            "spread": dict.fromkeys(self.states, 0.0) if p is None else self._by_state(p.spread),
            "harmless": p is None or p.harmless,
            "distribution": self.distribution,
        }
        if p is not None:
            out["ranked"] = [{"name": n, "spread": self._by_state(s)} for n, s in p.ranked()]
            out["queries"] = p.queries + self.spent
        if self.law is not None:
            out |= {"bound": self._by_state(self.bound), "safety": self.plan.safety}
        if self.attack:
            out["attack"] = dict(self.attack)
        return out

    def _by_state(self, values: Array) -> dict[str, float]:
        return dict(zip(self.states, values.tolist(), strict=True))

    def sentences(self) -> list[str]:
        """What the claim owes to the gates, for the list of assumptions."""
        made = [f"Hidden state that the domain names ({', '.join(self.names)}) is state here, and f holds it constant."]
        found = made if self.plan.mode == "augment" and self.names else []
        hidden = [] if self.probe is None else [self._hidden(self.probe)]
        return [*self.turns, *found, *hidden, *(f"Warning: {w}." for w in self.warnings)]

    def _hidden(self, p: Probe) -> str:
        listed = ", ".join(p.names)
        measured = ", ".join(f"{n} by {s:.3g}" for n, s in zip(self.states, p.spread, strict=True))
        if p.harmless:
            return (
                f"f̂ has hidden state ({listed}) that does not matter: moved alone, together and as visited in rollouts, it "
                f"changed {measured}, no more than rounding can; this was probed, not proved."
            )
        if self.law is None:
            return f"f̂ depends on hidden state ({listed}), which changed {measured}; the claim is about its default alone."
        bound = ", ".join(f"{n} by {2 * s:.3g}" for n, s in zip(self.states, self.bound, strict=True))
        return (
            f"f̂ depends on hidden state ({listed}); it is {self.law.describe()}. For any two such states and equal (x, u), r "
            f"differs by no more than {bound} (the largest difference seen, times {self.plan.safety:g}; an estimate is not a "
            f"bound){self.law.follows()}."
        )


def open_gate(
    model: Model, backend: System, domain: Domain, plan: HiddenPlan, seed: int, tell: Callable[[str], None] = lambda what: None
) -> Gate:
    """Probe the hidden state and take the branch that `plan` names; UsageError where it matters and nothing is planned.

    tell: called with what is being done.
    """
    states = tuple(s.name for s in model.states)
    augmented = backend.names if isinstance(backend, Augmented) else ()
    names, none = tuple(s.name for s in backend.hidden), np.zeros(len(states))
    if unknown := [n for n in plan.ranges if n not in names]:
        raise UsageError(f"hidden: '{unknown[0]}' is no hidden state of the backend; there are {', '.join(names) or 'none'}")
    if augmented:
        plan = replace(plan, mode="augment")
    if not backend.hidden:
        return Gate(plan, backend, states, augmented, none)
    steps = THRESHOLDS.hidden_steps
    pool = visited(backend, domain, THRESHOLDS.hidden_runs, steps, seed, lambda k: tell(f"rollouts, step {k + 1} of {steps}"))
    tell("moved at random points")
    probed = probe(Residual(backend, model), domain, plan.ranges, pool, seed)
    if probed.harmless:
        tell("harmless so far, and drawn in the audit")
        drawn = HiddenDraws(backend, Around(backend, domain, plan.ranges, seed + 3), seed)
        spent = THRESHOLDS.harmless_runs * THRESHOLDS.harmless_steps
        return Gate(plan, backend, states, augmented or names, none, probed, spent=spent, audited=drawn)
    if plan.mode == "default":
        return Gate(plan, backend, states, augmented or names, none, probed)
    if plan.mode != "sample":
        raise UsageError(_refusal(probed, plan.mode == "augment", states, backend))
    law: Law
    if plan.ranges:
        if missing := [n for n, _ in probed.ranked() if n not in plan.ranges]:
            raise UsageError(
                f"hidden.sample.ranges: no range for {', '.join(missing)}, which matter ({_spreads(probed, states)}); add "
                f"{missing[0]}: [low, high], or use sample: {{visited: {{}}}}"
            )
        law, names, spent = Ranges(backend, plan.ranges), tuple(plan.ranges), THRESHOLDS.spread_draws * THRESHOLDS.spread_points
    else:
        steps = plan.steps
        pool = visited(backend, domain, plan.runs, steps, seed + 1, lambda k: tell(f"visited, step {k + 1} of {steps}"))
        law = Visited(pool, domain.width[: domain.nx], plan.near, [s.name for s in backend.states], plan.ignore)
        spent = plan.runs * steps + THRESHOLDS.spread_points * plan.near
    draws = HiddenDraws(backend, law, seed)
    bound = plan.safety * spread(draws, domain, seed)
    return Gate(plan, draws, states, names, bound, probed, law, spent=spent)


def probe(residual: Residual, domain: Domain, ranges: Mapping[str, Range], pool: Pool, seed: int) -> Probe:
    """Hidden states moved alone, all together, and as visited, at random (x, u); all queries in one batch."""
    backend, rng = residual.backend, np.random.default_rng([seed, 0x41DE])
    names = tuple(s.name for s in backend.hidden)
    rows = max(4, min(24, THRESHOLDS.hidden_queries // len(names)))
    x, u = domain.split(domain.draw(THRESHOLDS.hidden_together, rng))
    groups = [(x[:rows], u[:rows], moved(backend, rows, rng, ranges, (n,))) for n in names]
    groups += [(x, u, moved(backend, len(x), rng, ranges)), _met(domain, pool, rng, THRESHOLDS.hidden_together)]
    at = [np.concatenate(parts) for parts in zip(*groups, strict=True)]
    plain, other = backend.step(at[0], at[1]).x, backend.step(at[0], at[1], hidden=at[2]).x
    if (lost := ~np.isfinite(other).all(axis=1)).any():
        k = int(np.argmax(lost))
        raise UsageError(
            f"certify: the backend steps from (x, u) = {at[0][k].tolist() + at[1][k].tolist()} with hidden state "
            f"{at[2][k].tolist()} to {other[k].tolist()}; declare ranges for its hidden state, or mend the backend"
        )
    d = change(backend, other, plain)
    gap = np.abs(difference(residual.model.states, plain, residual.model.step(at[0], at[1]).x)).mean(axis=0)
    e = residual.resolution(domain)
    parts = np.split(d, np.cumsum([len(g[0]) for g in groups])[:-1])
    largest = np.array([p.max(axis=0) if len(p) else np.zeros(d.shape[1]) for p in parts])
    k = int(np.argmax((d / np.maximum(gap, e)).max(axis=1)))
    witness = {"x": at[0][k], "u": at[1][k], "hidden": at[2][k], "default": plain[k], "moved": other[k]}
    spent = 2 * len(d) + THRESHOLDS.hidden_runs * THRESHOLDS.hidden_steps
    return Probe(names, largest[:-2], largest[-2], largest[-1], gap, e, {n: v.tolist() for n, v in witness.items()}, spent)


def _met(domain: Domain, pool: Pool, rng: np.random.Generator, most: int) -> tuple[Array, Array, Array]:
    """(x, u, h) of up to `most` visited states, each with a new input."""
    pick = rng.permutation(len(pool))[:most]
    u, inside = inputs(domain, pool.x[pick], rng)
    return pool.x[pick][inside], u[inside], pool.h[pick][inside]


def spread(draws: HiddenDraws, domain: Domain, seed: int) -> Array:
    """s (nx,): half the largest difference between two draws at one (x, u), over 64 points and 16 or so draws at each."""
    x, u = domain.split(domain.draw(THRESHOLDS.spread_points, np.random.default_rng([seed, 0x59D])))
    hs = draws.law.extremes(x, THRESHOLDS.spread_draws)
    after = draws.system.step(np.tile(x, (len(hs), 1)), np.tile(u, (len(hs), 1)), hidden=np.vstack(hs)).x
    after = after.reshape(len(hs), len(x), -1)
    # Differences to the first draw: on the circle, a mean or a range of the angles themselves would have no meaning.
    d = difference(draws.system.states, after, np.broadcast_to(after[:1], after.shape))
    return np.asarray(np.ptp(d, axis=0).max(axis=0) / 2)


def attacked(
    gate: Gate, gap: GapFunction, problem: GapProblem, model: Model, enter: Callable[[], Entry], emit: Emit = silent
) -> Gate:
    """γ of the default hidden state, asked about others: the share of probes with |r| > γ, and the worst.

    `enter` has the book count it: by that entry it is drawn, so that no fit can know what is asked. Half of the probes move the
    hidden state as the gate does, the others are visited in rollouts. Where hidden state does not matter or is drawn, the
    audit has asked already.
    """
    if gate.probe is None or gate.probe.harmless or gate.law is not None:
        return gate
    backend, domain, entry, n = gate.system, problem.domain, enter(), THRESHOLDS.hidden_attack
    rng = entry.draws(problem.seed, "hidden state")
    x, u = domain.split(domain.draw(n, rng))
    pulse = Pulse(emit, "attack", THRESHOLDS.hidden_steps + -(-2 * n // _BLOCK), "steps", "from other hidden states")
    met = visited(backend, domain, n // 8, THRESHOLDS.hidden_steps, int(rng.integers(2**32)), pulse)
    parts = [(x, u, moved(backend, n, rng, gate.plan.ranges)), _met(domain, met, rng, n)]
    x, u, h = (np.concatenate(part) for part in zip(*parts, strict=True))
    gamma, after = gap.gamma(np.hstack([x, u])), []
    for first in range(0, len(x), _BLOCK):
        pulse(THRESHOLDS.hidden_steps + first // _BLOCK)
        block = slice(first, first + _BLOCK)
        after.append(backend.step(x[block], u[block], hidden=h[block]).x)
    r = difference(model.states, np.concatenate(after), model.step(x, u).x)
    above = (np.abs(r) > gamma).any(axis=1)
    out: dict[str, Any] = {"points": len(x), "violations": int(above.sum()), "share": float(above.mean()), **entry.summary()}
    if above.any():
        k, i = np.unravel_index(int(np.argmax(np.abs(r) / np.maximum(gamma, np.finfo(float).tiny))), r.shape)
        witness = {"z": [*x[k].tolist(), *u[k].tolist()], "hidden": h[k].tolist(), "state": gate.states[i]}
        out["witness"] = {**witness, "residual": float(r[k, i]), "gamma": float(gamma[k, i])}
    return replace(gate, attack=out)


def _spreads(probed: Probe, states: Sequence[str]) -> str:
    return "; ".join(f"{n} moves {_by(states, s, probed.gap)}" for n, s in probed.ranked()[:8])


def _by(states: Sequence[str], values: Array, gap: Array) -> str:
    parts = [
        f"{n} by {v:.3g}" + (f" ({v / g:.2g} of its mean gap)" if g > 0 else "")
        for n, v, g in zip(states, values, gap, strict=True)
        if v > 0
    ]
    return " and ".join(parts)


def _refusal(p: Probe, augmenting: bool, states: Sequence[str], backend: System) -> str:
    """What was found, two hidden states with two different x⁺ under one (x, u), and which settings would solve it."""
    names = [n for n, _ in p.ranked()] or list(p.names)
    w, parts = p.witness, [_spreads(p, states)]
    for how, values in (("all together", p.together), ("as visited in rollouts", p.met)):
        parts.append(f"{how} they move {_by(states, values, p.gap)}" if (values > THRESHOLDS.harmless * p.e).any() else "")
    found = "; ".join(filter(None, parts))
    head = (
        f"certify: the backend depends on hidden state ({', '.join(names)}), so its gap is no function of (x, u): {found}. "
        f"From (x, u) = {_short(w['x'] + w['u'])} it steps to {_short(w['default'])} with {_named(w, backend, 'rest')}, and to "
        f"{_short(w['moved'])} with {_named(w, backend, 'hidden')}"
    )
    if augmenting:
        return f"{head}; domain: no range for {', '.join(names)}: add {names[0]}: [low, high]"
    return (
        f"{head}; make them states (hidden: augment, with ranges in domain:), bound over them (hidden: {{sample: {{ranges: "
        f"{{{names[0]}: [low, high]}}}}}} or {{sample: {{visited: {{}}}}}}), or measure them in the model"
    )


def _named(w: Mapping[str, list[float]], backend: System, key: str) -> str:
    """Those hidden states that the witness has moved, at their default (`rest`) or moved (`hidden`)."""
    rest = list(backend.hidden_default)
    values = rest if key == "rest" else w["hidden"]
    parts = [
        f"{s.name} = {_short(values[part]) if s.size > 1 else f'{values[part][0]:.6g}'}"
        for s, part in zip(backend.hidden, columns(backend.hidden), strict=True)
        if w["hidden"][part] != rest[part]
    ]
    return ", ".join(parts[:6]) + (", …" if len(parts) > 6 else "")


def _short(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{v:.6g}" for v in values) + "]"
