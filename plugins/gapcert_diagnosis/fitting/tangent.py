"""The linearised motion of fitted windows: what a small force along the path would do to the measured channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import final

import numpy as np

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Windows, flat
from gapcert_diagnosis.search.candidates import probe, velocity

from .fit import Fit

NUDGE, LITTLE = 1e-6, 1e-3  # of a state's size, and what counts as its size at least
COARSE = 0.01


@final
@dataclass(frozen=True)
class Tangent:
    """Windows along a fitted path: x, u (W, S, ·) at every model step, A (W, S, nx, nx), residual (W, L·ny), measured − fitted.

    observe (W, L, ny, nx): slopes of the measured channels in units of the noise floor; free (W, L·ny, nx): an orthonormal
    basis of what the start of a window can make, which is never held against a model.
    """

    model: Model
    windows: Windows
    x: Array
    u: Array
    A: Array
    observe: Array
    residual: Array
    free: Array
    _made: dict[object, Array] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, model: Model, windows: Windows, fitted: Fit) -> Tangent:
        """model: linearised where the path of the fit on these windows lies."""
        m, nx = windows.measured, model.nx
        x = fitted.hypothesis.motion(windows, fitted.theta[None], fitted.start[None])
        u = windows.drive()[:, m.history * m.repeat :][:, : x.shape[1]]
        at = flat(x[:, :: m.repeat]), flat(u[:, :: m.repeat])
        shifted = model.output(np.repeat(at[0], nx, axis=0) + np.tile(NUDGE * np.eye(nx), (len(at[0]), 1)), at[1].repeat(nx, 0))
        slope = difference(model.outputs, shifted.reshape(len(at[0]), nx, -1), model.output(*at)[:, None]) / NUDGE
        observe = np.swapaxes(slope[..., m.columns] / m.sigma, 1, 2).reshape(*windows.y.shape, nx) * windows.weight[..., None]
        x, u = x[:, :-1], u[:, : x.shape[1] - 1]
        A = model.jacobian(flat(x), flat(u))[:, :, :nx].reshape(*x.shape, nx) if model.hidden else _slopes(model, x, u)
        rows = _pushed(A, observe, m.repeat, np.tile(np.eye(nx), (len(windows), 1, 1)), np.empty((*x.shape, 0)))
        residual = -fitted.residual.reshape(len(windows), -1)
        return cls(model, windows, x, u, A, observe, residual, np.linalg.qr(np.nan_to_num(rows))[0])

    def responses(self, site: str, force: Array) -> Array:
        """What forces (W, S, K) at a site do to the measured channels, (W, L·ny, K), with the starts free to follow."""
        return self.driven(self.probed(site).reshape(self.x.shape), force)

    def probed(self, site: str) -> Array:
        """∂x⁺/∂f (W·S, nx) for a force f at a coordinate, held for one step."""
        return self.once(("probe", site), lambda: self._probed(site))

    def _probed(self, site: str) -> Array:
        plain = self.moved() if "forces" in self.model.capabilities else None
        return probe(self.model, site, flat(self.x), flat(self.u), plain)

    def moved(self) -> Array:
        """States (W·S, nx) one step after those of the path."""
        return self.once("moved", lambda: self.model.step(flat(self.x), flat(self.u)).x)

    def once(self, key: object, make: Callable[[], Array]) -> Array:
        """What depends on the path alone, made when it is first asked for."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def driven(self, B: Array, force: Array) -> Array:
        """The same for whatever moves the next state by B (W, S, nx) per unit."""
        still = np.zeros((len(force), self.model.nx, force.shape[2]))
        return self._project(_pushed(self.A, self.observe, self.windows.measured.repeat, still, force, B))

    def weighed(self, rows: Array) -> tuple[Array, Array]:
        """What a change of the state after each step adds to products of the measured channels: (W, S, nx, m) with rows
        (W, L·ny, m), and (W, S, nx, nx) with themselves.
        """
        repeat, against = self.windows.measured.repeat, rows.reshape(*self.observe.shape[:3], -1)
        with_rows, own = np.empty((*self.x.shape, against.shape[3])), np.empty(self.A.shape)
        a, b = np.zeros_like(with_rows[:, 0]), np.zeros_like(own[:, 0])
        with np.errstate(all="ignore"):
            for i in reversed(range(self.x.shape[1])):
                k, rest = divmod(i + 1, repeat)
                if not rest:
                    seen = np.swapaxes(self.observe[:, k], 1, 2)
                    a, b = a + seen @ against[:, k], b + seen @ self.observe[:, k]
                with_rows[:, i], own[:, i] = a, b
                back = np.swapaxes(self.A[:, i], 1, 2)
                a, b = back @ a, back @ b @ self.A[:, i]
        return with_rows, own

    def project(self, rows: Array) -> Array:
        """Without what the starts can make; (W, L·ny, K) or (W, L·ny)."""
        return self._project(rows.copy())

    def _project(self, rows: Array) -> Array:
        """The same in place, a window at a time: what forces make is larger than caches."""
        for free, columns in zip(self.free, rows.reshape(*rows.shape[:2], -1), strict=True):
            columns -= free @ (free.T @ columns)
        return rows

    def coarse(self, rows: Array) -> Array:
        """Means over COARSE s of rows (W, L·ny, K), for regressions; their squares still add up to what the rows carry."""
        w, length, ny = self.windows.y.shape
        block = max(1, round(COARSE / self.windows.measured.period))
        count = length // block
        kept = rows.reshape(w, length, ny, -1)[:, : count * block].reshape(w, count, block, ny, -1)
        return np.asarray(kept.mean(axis=2).reshape(w, count * ny, -1) * np.sqrt(block))

    def place(self, site: str) -> tuple[int | None, int]:
        """(position, velocity) columns of the state at a coordinate; a state equation may have no position."""
        names = [s.name for s in self.model.states]
        if f"{site}_dot" in names:
            return names.index(site), names.index(f"{site}_dot")
        v = names.index(site)
        # ∂xᵢ⁺/∂xⱼ ≈ period: xⱼ is the velocity of xᵢ.
        driven = np.abs(self.A[..., v] / self.model.period - 1).mean(axis=(0, 1)) < 0.05
        return (int(np.argmax(driven)) if driven.any() else None), v

    def drives(self) -> list[Array]:
        """The inputs of each uninterrupted piece of the recording at every model step, (T·repeat, nu)."""
        m = self.windows.measured
        return list(m.drives[m.hold or "zero"])

    def paths(self) -> list[Array]:
        """The smoothed states of each piece at every model step, (T·repeat, nx)."""
        m = self.windows.measured
        fine = [np.arange(len(x) * m.repeat) / m.repeat for x in m.states]
        return [
            np.stack([np.interp(t, np.arange(len(x)), column) for column in x.T], axis=-1)
            for t, x in zip(fine, m.states, strict=True)
        ]

    def gather(self, pieces: list[Array]) -> Array:
        """What belongs to the windows, (W, S, K), of values at every model step of each piece."""
        repeat, steps = self.windows.measured.repeat, self.x.shape[1]
        return np.stack([pieces[i][s * repeat : s * repeat + steps] for i, s in self.windows.place.tolist()])

    def effort(self, site: str) -> Array:
        """The force (W, S) that moves the path: what stands against its acceleration without inputs, and the inputs' share."""
        x, u, states = flat(self.x), flat(self.u), self.model.states
        response = self.probed(site)
        v = velocity(self.model, site, response)
        gain = np.where(np.abs(response[:, v]) > 1e-9 * np.abs(response[:, v]).max(), response[:, v], np.inf)
        still = self.once("still", lambda: self.model.step(x, np.zeros_like(u)).x)
        inertial, driven = (difference(states, self.moved(), other)[:, v] / gain for other in (x, still))
        return np.asarray(np.hypot(inertial, driven)).reshape(self.x.shape[:2])


def _slopes(model: Model, x: Array, u: Array) -> Array:
    """∂x⁺/∂x (W, S, nx, nx) along motions, by differences: derivatives of long expressions cost several times as much."""
    nx = model.nx
    size = NUDGE * np.maximum(np.sqrt(np.mean(x**2, axis=(0, 1))), LITTLE)
    moved = np.concatenate([x, *(x + size * e for e in np.eye(nx))])
    new = model.along(moved, np.tile(u, (nx + 1, 1, 1))).reshape(nx + 1, *x.shape)
    return np.asarray(np.moveaxis(difference(model.states, new[1:], new[:1]), 0, -1) / size)


def _pushed(A: Array, observe: Array, repeat: int, state: Array, force: Array, B: Array | None = None) -> Array:
    """Outputs (W, L·ny, K) of the linear motion from `state` (W, nx, K) under forces (W, S, K)."""
    (w, steps, nx, _), count = A.shape, state.shape[2]
    out = np.empty((w, steps // repeat + 1, observe.shape[2], count))
    np.matmul(observe[:, 0], state, out=out[:, 0])
    if B is not None:
        # The force is one more state.
        A = np.concatenate([A, B[..., None]], axis=3)
    now, new = np.zeros((w, A.shape[3], count)), np.zeros((w, A.shape[3], count))
    now[:, :nx] = state
    for i in range(steps):
        if B is not None:
            now[:, nx] = force[:, i]
        np.matmul(A[:, i], now, out=new[:, :nx])
        now, new = new, now
        if (i + 1) % repeat == 0:
            k = (i + 1) // repeat
            np.matmul(observe[:, k], now[:, :nx], out=out[:, k])
    return out.reshape(w, -1, count)
