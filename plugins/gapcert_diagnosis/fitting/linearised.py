"""Linearised motions along windows: what small changes of starts, steps and numbers do to the measured channels.

x_{k+1} = A_k x_k + d_k at model steps and y = C x at samples. Screening linearises along the measured, smoothed path, tests of
what a fit leaves along the fitted one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Extension, Model, Parameter, difference, site_units
from gapcert_diagnosis.data.dataset import Windows, flat, once
from gapcert_diagnosis.thresholds import THRESHOLDS

from .fit import Fit
from .hypothesis import nudges, recalled, seen, shows_memory, shows_states, within
from .step_size import built


@final
@dataclass(frozen=True, eq=False)
class LinearisedMotion:
    """A (W, S, nx, nx) per model step, observe (W, L, ny, nx) per sample, `repeat` steps apart; y summed over `block` samples.

    What is made are rows (W, N, K), N = L // block · ny. steep: a column that comes to more, or to no number, says nothing and
    is made zero; None for all as they are.
    """

    A: Array
    observe: Array
    repeat: int
    block: int = 1
    steep: float | None = None

    @cached_property
    def free(self) -> Array:
        """An orthonormal basis (W, N, nx) of what starts make."""
        w, _, nx, _ = self.A.shape
        return np.linalg.qr(np.nan_to_num(self.push(np.tile(np.eye(nx), (w, 1, 1)))))[0]

    def push(
        self, start: Array | None = None, added: Array | None = None, along: Array | None = None, force: Array | None = None
    ) -> Array:
        """Rows that starts (W, nx, K) make, and what each step adds to the state: `added` (W, S, nx, K), or as many `along`
        (W, S, nx) as forces (W, S, K) are.
        """
        # A force is one more state.
        A = self.A if along is None else np.concatenate([self.A, along[..., None]], axis=3)
        blocks, count = self.observe.shape[1] // self.block, _count(start, added, force)
        out = np.zeros((len(A), blocks, self.observe.shape[2], count))
        with np.errstate(all="ignore"):
            for k, state in enumerate(states(A, start, added, force)):
                sample, rest = divmod(k, self.repeat)
                if not rest and sample // self.block < blocks:
                    out[:, sample // self.block] += self.observe[:, sample] @ state
            if self.steep is not None and not (usable := np.abs(out).max(axis=(0, 1, 2)) < self.steep).all():
                out = np.where(usable, out, 0.0)
        return _rows(out)

    def adjoint(self, rows: Array) -> tuple[Array, Array]:
        """What a change of the state after each step adds to products of the channels: (W, S, nx, m) with rows (W, N, m), and
        (W, S, nx, nx) with themselves. Of a motion whose samples are not summed.
        """
        against = rows.reshape(*self.observe.shape[:3], -1)
        with_rows, own = np.empty((*self.A.shape[:3], against.shape[3])), np.empty(self.A.shape)
        a, b = np.zeros_like(with_rows[:, 0]), np.zeros_like(own[:, 0])
        with np.errstate(all="ignore"):
            for i in reversed(range(self.A.shape[1])):
                k, rest = divmod(i + 1, self.repeat)
                if not rest:
                    seen = np.swapaxes(self.observe[:, k], 1, 2)
                    a, b = a + seen @ against[:, k], b + seen @ self.observe[:, k]
                with_rows[:, i], own[:, i] = a, b
                back = np.swapaxes(self.A[:, i], 1, 2)
                a, b = back @ a, back @ b @ self.A[:, i]
        return with_rows, own

    def project(self, rows: Array) -> Array:
        """Rows without what starts make, in place and a window at a time: what forces make is larger than caches."""
        for free, columns in zip(self.free, rows, strict=True):
            columns -= free @ (free.T @ columns)
        return rows

    def blocks(self, samples: Array) -> Array:
        """Rows of samples (W, L, ny, K): their sums over blocks, with the noise that one sample has."""
        return _rows(in_blocks(samples, self.block).sum(axis=2) / math.sqrt(self.block))


def states(A: Array, start: Array | None = None, added: Array | None = None, force: Array | None = None) -> Iterator[Array]:
    """States (W, nx, K) from `start` on, after every step of A (W, S, nx, ·), in an array that the next step overwrites.

    added (W, S, nx, K): to each; force (W, S, K): the last state before each step, whatever the step before made of it.
    """
    w, steps, nx, inner = A.shape
    now, new = np.zeros((2, w, inner, _count(start, added, force)))
    if start is not None:
        now[:, :nx] = start
    yield now[:, :nx]
    for i in range(steps):
        if force is not None:
            now[:, -1] = force[:, i]
        np.matmul(A[:, i], now, out=new[:, :nx])
        if added is not None:
            new += added[:, i]
        now, new = new, now
        yield now[:, :nx]


def _count(*columns: Array | None) -> int:
    return int(next(a.shape[-1] for a in columns if a is not None))


def in_blocks(samples: Array, size: int) -> Array:
    """(W, L, …) → (W, L // size, size, …)."""
    count = samples.shape[1] // size
    return np.asarray(samples[:, : count * size].reshape(len(samples), count, size, *samples.shape[2:]))


def shortened(samples: Array, parts: int) -> Array:
    """(W, L, …) → (W·parts, L // parts, …)."""
    length = samples.shape[1] // parts
    return in_blocks(samples, length)[:, :parts].reshape(len(samples) * parts, length, *samples.shape[2:])


def _rows(out: Array) -> Array:
    """(W, L, ny, K) → (W, L·ny, K); K may be 0."""
    return out.reshape(len(out), out.shape[1] * out.shape[2], out.shape[3])


@final
class Path:
    """The measured motion of windows at every model step, history first: x (W, P + S, nx), u (W, P + S, nu)."""

    def __init__(self, windows: Windows, guess: Fit, start: Array) -> None:
        """start (W, nx): of these windows, as the guess has them."""
        m, repeat = windows.measured, windows.measured.repeat
        self.windows, self.lead, self.acted = windows, m.past, guess.hypothesis.acted
        steps = self.lead + (windows.length - 1) * repeat
        self.u = windows.drive[:, :steps]
        samples = np.stack([m.states[i][s - m.history : s + windows.length] for i, s in windows.place.tolist()])
        self._fill(samples, guess, start)
        share = np.arange(repeat) / repeat
        between = samples[:, :-1, None] + share[:, None] * np.diff(samples, axis=1)[:, :, None]
        self.x, self.samples = between.reshape(len(windows), steps, -1), samples

    def _fill(self, samples: Array, guess: Fit, start: Array) -> None:
        """States that no channel shows are those of the fit."""
        blind, history = ~np.any(samples, axis=(0, 1)), self.windows.measured.history
        if blind.any():
            motion = guess.hypothesis.motion(self.windows, guess.theta[None], start[None])
            found = np.nan_to_num(motion[:, :: max(1, motion.shape[1] // self.windows.length)][:, : self.windows.length])
            samples[:, history:, blind] = found[..., blind]
            samples[:, :history, blind] = found[:, :1, blind]

    def next(
        self, model: Model, parameters: Mapping[str, Array], copies: int = 1, moved: Array | None = None, every: int = 1
    ) -> Array:
        """One step of a model from every state of the path, (copies, W, S, nx); parameters: name → (copies,).

        every: without hidden states, from every so many states only.
        """
        w, first, every = len(self.windows), 0 if model.hidden else self.lead, 1 if model.hidden else every
        x, u = (a[:, first::every] for a in (self.x, self.u))
        x, u = (np.broadcast_to(a, (copies, *a.shape)) for a in (x, u))
        if moved is not None:
            x = x + moved[:, None, None]
        new = model.along(
            x.reshape(copies * w, *x.shape[2:]),
            u.reshape(copies * w, *u.shape[2:]),
            parameters={n: np.repeat(v, w) for n, v in parameters.items()} or None,
            hidden=recalled(model, self.windows, parameters, copies, self.acted) if model.hidden else None,
        )
        return np.asarray(new.reshape(copies, w, *new.shape[1:])[:, :, self.lead - first :])

    def output(self, model: Model, parameters: Mapping[str, float], moved: Array | float = 0.0) -> Array:
        """Measured channels (W, L, ny) of the path, late where the model says so."""
        m, count = self.windows.measured, self.samples.shape[1]
        rows = {n: np.array([v]) for n, v in parameters.items()}
        hidden = recalled(model, self.windows, rows, 1, self.acted) if shows_memory(model) else None
        late = model.output_delays(parameters or None) / m.period
        if late.any() and m.hold == "zero" and shows_states(model):
            return self._late(model, parameters, moved, late[list(m.columns)])
        y = seen(model, self.windows, self.samples + moved, parameters, hidden, m.history, self.acted)
        at, out = np.arange(count), y.copy()
        for c in np.flatnonzero(late).tolist():
            for w in range(len(y)):
                out[w, :, c] = np.interp(at - late[c], at, y[w, :, c])
        return np.asarray(out[:, m.history :][..., m.columns])

    def _late(self, model: Model, parameters: Mapping[str, float], moved: Array | float, late: Array) -> Array:
        """Channels that come `late` (ny,) samples: between two samples a motion bends as the model does, and meets both."""
        m, x = self.windows.measured, [self.samples[:, :-1] + moved]
        for k in range(m.repeat):
            x.append(model.along(x[-1], self.u[:, k :: m.repeat], parameters=parameters or None))
        missed = (self.samples[:, 1:] + moved - x.pop())[..., m.columns]
        at = np.maximum(np.arange(m.history, self.samples.shape[1])[:, None] - late, 0)
        piece = np.minimum(at.astype(np.int64), missed.shape[1] - 1)
        steps, times = np.stack(x, axis=2).reshape(len(self.u), -1, model.nx), np.tile(at * m.repeat, (len(self.u), 1, 1))
        shown = within(model, steps, self.u, times, m.columns, parameters or None, None)
        return np.asarray(shown + (at - piece) * missed[:, piece, np.arange(len(m.columns))])


@final
@dataclass(frozen=True)
class Motion:
    """The linearised motion along the path: A (W, S, nx, nx), observe (W, L, ny, nx), and slopes in the free numbers of a fit.

    free (W, S, nx, p) per step; shown (W, L, ny, p) at the output.
    """

    A: Array
    observe: Array
    free: Array
    shown: Array

    @classmethod
    def of(cls, path: Path, fit: Fit) -> Motion:
        h, model, nx, p = fit.hypothesis, fit.hypothesis.model, fit.hypothesis.model.nx, len(fit.theta)
        size = nudges(path.x)
        width = np.where(fit.theta + h.step > h.high, -h.step, h.step)
        theta = np.tile(fit.theta, (1 + nx + p, 1))
        theta[1 + nx + np.arange(p), np.arange(p)] += width
        moved = np.zeros((1 + nx + p, nx))
        moved[1 + np.arange(nx), np.arange(nx)] = size
        scale = np.concatenate([size, width])
        new = path.next(model, dict(zip(h.names, theta.T, strict=True)), 1 + nx + p, moved)
        state = np.moveaxis(difference(model.states, new[1:], new[:1]), 0, -1) / scale
        values = [dict(zip(h.names, row, strict=True)) for row in theta.tolist()]
        plain, *others = (path.output(model, v, d) for v, d in zip(values, moved, strict=True))
        channels = path.windows.measured.channels
        shown = np.stack([difference(channels, y, plain) for y in others], axis=-1) / scale
        parts = state[..., :nx], shown[..., :nx], state[..., nx:], shown[..., nx:]
        return cls(*(np.ascontiguousarray(np.nan_to_num(a, nan=0.0, posinf=0.0, neginf=0.0)) for a in parts))


@final
@dataclass(frozen=True)
class Tangent:
    """Windows along the path of a fit: x, u (W, S, ·) at every model step, residual (W, L·ny), measured − fitted.

    linear: the motion beside it, in units of the noise floor; what starts make of it is never held against a model.
    """

    model: Model
    windows: Windows
    fitted: Fit
    x: Array
    u: Array
    linear: LinearisedMotion
    residual: Array
    _made: dict[object, Array] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, model: Model, fitted: Fit) -> Tangent:
        """model: linearised where the path of the fit lies."""
        windows, m, nx = fitted.windows, fitted.windows.measured, model.nx
        x = fitted.hypothesis.motion(windows, fitted.theta[None], fitted.start[None])
        u = windows.drive[:, m.past :][:, : x.shape[1]]
        at = flat(x[:, :: m.repeat]), flat(u[:, :: m.repeat])
        shifted = model.output(
            np.repeat(at[0], nx, axis=0) + np.tile(THRESHOLDS.tangent_nudge * np.eye(nx), (len(at[0]), 1)), at[1].repeat(nx, 0)
        )
        slope = (
            difference(model.outputs, shifted.reshape(len(at[0]), nx, -1), model.output(*at)[:, None])
            / THRESHOLDS.tangent_nudge
        )
        observe = np.swapaxes(slope[..., m.columns] / m.sigma, 1, 2).reshape(*windows.y.shape, nx) * windows.weight[..., None]
        x, u = x[:, :-1], u[:, : x.shape[1] - 1]
        A = model.jacobian(flat(x), flat(u))[:, :, :nx].reshape(*x.shape, nx) if model.hidden else _slopes(model, x, u)
        residual = -fitted.residual.reshape(len(windows), -1)
        return cls(model, windows, fitted, x, u, LinearisedMotion(A, observe, m.repeat), residual)

    def responses(self, site: str, force: Array) -> Array:
        """What forces (W, S, K) at a site do to the measured channels, (W, L·ny, K), with the starts free to follow."""
        return self.driven(self.probed(site).reshape(self.x.shape), force)

    def probed(self, site: str) -> Array:
        """∂x⁺/∂f (W·S, nx) for a force f at a coordinate, held for one step."""
        plain = self.after if "forces" in self.model.capabilities else None
        return self.once(("probe", site), lambda: probe(self.model, site, flat(self.x), flat(self.u), plain))

    @cached_property
    def after(self) -> Array:
        """States (W·S, nx) one step after those of the path."""
        return self.model.step(flat(self.x), flat(self.u)).x

    def once(self, key: object, make: Callable[[], Array]) -> Array:
        """What depends on the path alone, made when it is first asked for."""
        return once(self._made, key, make)

    def driven(self, B: Array, force: Array) -> Array:
        """The same for whatever moves the next state by B (W, S, nx) per unit."""
        return self.linear.project(self.linear.push(along=B, force=force))

    def felt(self, B: Array) -> bool:
        """Does any channel show what moves the next state by B (W, S, nx)?"""
        return bool(self.driven(B, np.ones((*self.x.shape[:2], 1))).any())

    def shown(self, channel: int, added: Array) -> Array:
        """What is added (W, S, K) to one measured channel, (W, L·ny, K), with the starts free to follow."""
        samples = np.concatenate([added[:, :: self.windows.measured.repeat], added[:, -1:]], axis=1)
        rows = np.zeros((*self.windows.y.shape, added.shape[2]))
        rows[:, :, channel] = samples[:, : rows.shape[1]] * self.windows.weight[:, :, channel, None]
        return self.linear.project(_rows(rows))

    def project(self, rows: Array) -> Array:
        """Rows (W, L·ny, K), or (W, L·ny), without what the starts can make."""
        return self.linear.project(rows.copy().reshape(*rows.shape[:2], -1)).reshape(rows.shape)

    def coarse(self, rows: Array) -> Array:
        """Means over `regression_block` s of rows (W, L·ny, K), for regressions; their squares still add up to what the rows
        carry."""
        block = max(1, round(THRESHOLDS.regression_block / self.windows.measured.period))
        kept = in_blocks(rows.reshape(*self.windows.y.shape, -1), block).mean(axis=2) * np.sqrt(block)
        return np.asarray(kept.reshape(len(kept), -1, kept.shape[-1]))

    def place(self, site: str) -> tuple[int | None, int]:
        """(position, velocity) columns of the state at a coordinate; a state equation may have no position."""
        names = [s.name for s in self.model.states]
        if f"{site}_dot" in names:
            return names.index(site), names.index(f"{site}_dot")
        v = names.index(site)
        # ∂xᵢ⁺/∂xⱼ ≈ period: xⱼ is the velocity of xᵢ.
        driven = np.abs(self.linear.A[..., v] / self.model.period - 1).mean(axis=(0, 1)) < 0.05
        driven[v] = False
        return (int(np.argmax(driven)) if driven.any() else None), v

    def gather(self, pieces: list[Array]) -> Array:
        """What belongs to the windows, (W, S, K), of values at every model step of each piece."""
        repeat, steps = self.windows.measured.repeat, self.x.shape[1]
        return np.stack([pieces[i][s * repeat : s * repeat + steps] for i, s in self.windows.place.tolist()])

    def effort(self, site: str) -> Array:
        """The force (W, S) that moves the path: what stands against its acceleration without inputs, and the inputs' share."""
        x, u, response = flat(self.x), flat(self.u), self.probed(site)
        v = velocity(self.model, site, response)
        gain = np.where(np.abs(response[:, v]) > 1e-9 * np.abs(response[:, v]).max(), response[:, v], np.inf)
        still = self.once("still", lambda: self.model.step(x, np.zeros_like(u)).x)
        inertial, driven = (difference(self.model.states, self.after, other)[:, v] / gain for other in (x, still))
        return np.asarray(np.hypot(inertial, driven)).reshape(self.x.shape[:2])


def _slopes(model: Model, x: Array, u: Array) -> Array:
    """∂x⁺/∂x (W, S, nx, nx) along motions, by differences: derivatives of long expressions cost several times as much."""
    nx, size = model.nx, nudges(x, THRESHOLDS.tangent_nudge)
    moved = np.concatenate([x, *(x + size * e for e in np.eye(nx))])
    new = model.along(moved, np.tile(u, (nx + 1, 1, 1))).reshape(nx + 1, *x.shape)
    return np.asarray(np.moveaxis(difference(model.states, new[1:], new[:1]), 0, -1) / size)


def sliding(model: Model, site: str, x: Array, u: Array, plain: Array | None = None) -> Array:
    """∂x⁺/∂f (n, nx) of the machine as it slides: what turns a change of the state into a force, also where friction holds."""
    spec = model.to_spec()
    if spec.get("dry_friction"):
        return probe(built({**spec, "dry_friction": {}}), site, x, u)
    return probe(model, site, x, u, plain)


def probe(model: Model, site: str, x: Array, u: Array, plain: Array | None = None) -> Array:
    """∂x⁺/∂f (n, nx) for a force f at a coordinate, held for one period; plain: x⁺ without it, where that is known."""
    if "forces" in model.capabilities:
        forces = np.zeros((len(x), model.substeps, len(model.coordinates)))
        forces[..., model.coordinates.index(site)] = 1.0
        plain = model.step(x, u).x if plain is None else plain
        return difference(model.states, model.step(x, u, forces=forces).x, plain)
    force = Parameter("probe_force", 0.0, site_units(model, "coordinate", site)["force"])
    pushed = model.extend([Extension("probe", site, (force,), force=force.name)])
    on, off = (pushed.step(x, u, parameters={"probe_force": f}).x for f in (1.0, 0.0))
    return difference(model.states, on, off)


def velocity(model: Model, site: str, response: Array) -> int:
    """The column of the state that a force at `site` changes first: its velocity, or the state whose equation the site is."""
    names = [s.name for s in model.states]
    for name in (f"{site}_dot", site):
        if name in names:
            return names.index(name)
    return int(np.argmax(np.abs(response).max(axis=0)))
