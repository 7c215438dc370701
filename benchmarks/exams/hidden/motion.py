"""The truth of the exams: fine explicit steps, joints that stick exactly, faults in the way of inputs and outputs.

Explicit trapezoid (or semi-implicit Euler) over steps of some ten µs. A dry joint has a mode: forwards, backwards or stuck. A
velocity that changes its sign within a step is clamped to zero and the joint sticks until the force it would take to hold it
exceeds the bound. It shares no formula and no code with the fits.
"""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np

from exams.hidden import slots as s
from exams.hidden.slots import compiled
from exams.hidden.terms import applied, bias, mass, solve
from gapcert.numerics.arrays import Array, Ints

NEAR = 1e-6  # steps


@final
class Machine(NamedTuple):
    """A plant by its number with its parameters, and its faults: per coordinate C, per input A, per output S (`slots`)."""

    plant: int
    p: Array
    exact: Array
    C: Array
    A: Array
    S: Array


@final
class Drive(NamedTuple):
    """What a machine is asked at the ticks (T,), in steps of h seconds, and what disturbs it (T, n).

    u (T, nu) is overwritten with what was commanded: clip(u + gains·(reference − y), ±limit). At tick resets[k] the state
    becomes starts[k] while all memories go on. scheme 0: trapezoid, 1: semi-implicit Euler; hold 1: commands run in straight
    lines from tick to tick, and must not depend on y.
    """

    ticks: Ints
    h: float
    u: Array
    gains: Array
    reference: Array
    limit: Array
    resets: Ints
    starts: Array
    disturbance: Array
    scheme: int
    hold: int


@compiled
def path(A: Array, i: int, memory: Array, value: float, step: float) -> float:
    """One input after its faults, and its memories (rate-limited, lagging, drained, followed) moved by one step.

    value: the command that has arrived.
    """
    if A[i, s.DEAD_ZONE] > 0:
        value = math.copysign(max(abs(value) - A[i, s.DEAD_ZONE], 0.0), value)
    value += A[i, s.SQUARE] * value**2 + A[i, s.CUBE] * value**3
    if A[i, s.FOLLOWED] > 0:
        memory[i, 3] = min(max(memory[i, 3], value - A[i, s.FOLLOWED]), value + A[i, s.FOLLOWED])
        value = memory[i, 3]
    if A[i, s.RATE] < np.inf:
        reach = A[i, s.RATE] * step
        memory[i, 0] += min(max(value - memory[i, 0], -reach), reach)
        value = memory[i, 0]
    if A[i, s.LAG] > 0:
        reach = A[i, s.LAG_RATE] * step
        moved = (value - memory[i, 1]) * (1 - math.exp(-step / A[i, s.LAG]))
        memory[i, 1] += min(max(moved, -reach), reach)
        value = memory[i, 1]
    if A[i, s.SAG] > 0:
        drained = memory[i, 2]
        memory[i, 2] += (abs(value) - drained) * (1 - math.exp(-step / A[i, s.SAG_TIME]))
        value *= max(1 - A[i, s.SAG] * drained, 0.0)
    value = A[i, s.GAIN] * value + A[i, s.OFFSET]
    return float(min(max(value, -A[i, s.SATURATION]), A[i, s.SATURATION]))


@compiled
def law(C: Array, j: int, q: float, v: float, z: float, w: float, t: float) -> float:
    """Force of everything at one coordinate that is not dry; z, w: bristles of Dahl and LuGre, for unit stiffness."""
    f = C[j, s.CONSTANT] - (C[j, s.VISCOUS_UP] if v > 0 else C[j, s.VISCOUS_DOWN]) * v - C[j, s.QUADRATIC] * v * abs(v)
    f -= C[j, s.SPRING] * q + C[j, s.CUBIC] * q * q * q
    if C[j, s.COGGING] != 0:
        f += C[j, s.COGGING] * math.sin(C[j, s.COGGING_FREQUENCY] * q + C[j, s.COGGING_PHASE])
    if C[j, s.PUSH] != 0 and C[j, s.PUSH_TIME] <= t < C[j, s.PUSH_TIME] + C[j, s.PUSH_DURATION]:
        f += C[j, s.PUSH]
    if C[j, s.DAHL] != 0:
        f -= C[j, s.DAHL_STIFFNESS] * z
    if C[j, s.LUGRE] != 0:
        f -= C[j, s.LUGRE_STIFFNESS] * w + C[j, s.LUGRE_DAMPING] * (
            v - abs(v) * C[j, s.LUGRE_STIFFNESS] * w / yielding(C, j, v)
        )
    return float(f)


@compiled
def yielding(C: Array, j: int, v: float) -> float:
    """Steady LuGre friction at speed v."""
    return float(C[j, s.LUGRE] + (C[j, s.LUGRE_STATIC] - C[j, s.LUGRE]) * math.exp(-((v / C[j, s.LUGRE_SPEED]) ** 2)))


@compiled
def bristles(C: Array, W: Array, j: int, step: float) -> None:
    """Bristles a step later, implicit: ż = v − |v| z/z_max."""
    v = 0.5 * (W[s.SPEED, j] + W[s.NEXT_SPEED, j])
    if C[j, s.DAHL] != 0:
        give = C[j, s.DAHL_STIFFNESS] / C[j, s.DAHL]
        W[s.BRISTLE, j] = (W[s.BRISTLE, j] + step * v) / (1 + step * abs(v) * give)
    if C[j, s.LUGRE] != 0:
        give = C[j, s.LUGRE_STIFFNESS] / yielding(C, j, v)
        W[s.LUGRE_BRISTLE, j] = (W[s.LUGRE_BRISTLE, j] + step * v) / (1 + step * abs(v) * give)


@compiled
def bound(C: Array, j: int, v: float, load: float, up: bool) -> float:
    """Dry friction bound in one direction."""
    value = (C[j, s.DRY_UP] if up else C[j, s.DRY_DOWN]) + C[j, s.LOAD] * abs(load)
    if C[j, s.STATIC] != 0:
        value += C[j, s.STATIC] * math.exp(-((v / C[j, s.STRIBECK_SPEED]) ** 2))
    return float(value)


@compiled
def dry(C: Array, j: int) -> bool:
    return bool(C[j, s.DRY_UP] > 0 or C[j, s.DRY_DOWN] > 0 or C[j, s.LOAD] > 0 or C[j, s.STATIC] != 0)


@compiled
def rates(
    machine: Machine, disturbance: Array, W: Array, M: Array, at: int, into: int, acting: Array, t: float, release: bool
) -> None:
    """Accelerations at the state in row `at` into row `into`; with `release`, stuck joints that cannot be held let go first."""
    C, n = machine.C, W.shape[1]
    mass(machine.plant, machine.p, machine.exact, C, W, at, M)
    bias(machine.plant, machine.p, machine.exact, C, W, at)
    applied(machine.plant, machine.p, W, at, acting)
    for j in range(n):
        if C[j, s.PLAY] > 0:
            W[s.PLAYED, j] = min(max(W[s.PLAYED, j], W[s.FORCE, j] - C[j, s.PLAY]), W[s.FORCE, j] + C[j, s.PLAY])
            W[s.FORCE, j] = W[s.PLAYED, j]
        if C[j, s.SLIP] > 0:
            W[s.FORCE, j] = C[j, s.SLIP] * math.tanh(W[s.FORCE, j] / C[j, s.SLIP])
        W[s.LOADED, j] = W[s.FORCE, j]
    for j in range(n):
        f = law(C, j, W[at, j], W[at + 1, j], W[s.BRISTLE, j], W[s.LUGRE_BRISTLE, j], t)
        W[s.FORCE, j] += f + disturbance[j] - W[s.BIASED, j]
        if C[j, s.COUPLING] != 0:
            W[s.FORCE, j] -= C[j, s.COUPLING] * W[at + 1, int(C[j, s.PARTNER])]
    for _ in range(n + 1):
        for j in range(n):
            W[s.NET, j] = W[s.FORCE, j]
            if dry(C, j) and W[s.MODE, j] > 0:
                W[s.NET, j] -= bound(C, j, W[at + 1, j], W[s.LOADED, j], True)
            elif dry(C, j) and W[s.MODE, j] < 0:
                W[s.NET, j] += bound(C, j, W[at + 1, j], W[s.LOADED, j], False)
        solve(M, W, into)
        if not release or not let_go(C, W, M, into):
            return


@compiled
def let_go(C: Array, W: Array, M: Array, into: int) -> bool:
    """Frees the stuck joint that is pulled hardest beyond its bound; False where all of them hold."""
    n = W.shape[1]
    worst, which, way = 0.0, -1, 0.0
    for j in range(n):
        if W[s.MODE, j] == 0:
            pull = W[s.FORCE, j]
            for k in range(n):
                pull -= M[0, j, k] * W[into, k]
            excess = abs(pull) - bound(C, j, 0.0, W[s.LOADED, j], pull > 0)
            if excess > worst:
                worst, which, way = excess, j, math.copysign(1.0, pull)
    if which < 0:
        return False
    W[s.MODE, which] = way
    return True


@compiled
def settle(C: Array, W: Array) -> None:
    """Modes that belong to the velocities as they are."""
    for j in range(W.shape[1]):
        v = W[s.SPEED, j]
        W[s.MODE, j] = math.copysign(1.0, v) if v != 0 or not dry(C, j) else 0.0


@compiled
def advance(machine: Machine, drive: Drive, W: Array, M: Array, acting: Array, k: int, t: float) -> None:
    """One fine step of the state in row NOW."""
    C, h, scheme, n = machine.C, drive.h, drive.scheme, W.shape[1]
    rates(machine, drive.disturbance[k], W, M, s.NOW, s.PULL, acting, t, True)
    for j in range(n):
        W[s.NEXT_SPEED, j] = W[s.SPEED, j] + h * W[s.PULL, j]
        W[s.NEXT, j] = W[s.NOW, j] + h * W[s.SPEED if scheme == 0 else s.NEXT_SPEED, j]
    if scheme == 0:
        rates(machine, drive.disturbance[k], W, M, s.NEXT, s.NEXT_PULL, acting, t + h, False)
        for j in range(n):
            W[s.NEXT, j] = W[s.NOW, j] + 0.5 * h * (W[s.SPEED, j] + W[s.NEXT_SPEED, j])
            W[s.NEXT_SPEED, j] = W[s.SPEED, j] + 0.5 * h * (W[s.PULL, j] + W[s.NEXT_PULL, j])
    for j in range(n):
        bristles(C, W, j, h)
        W[s.NOW, j], W[s.SPEED, j] = W[s.NEXT, j], W[s.NEXT_SPEED, j]
        if not dry(C, j):
            W[s.MODE, j] = 1.0
        elif W[s.SPEED, j] * W[s.MODE, j] < 0:
            W[s.SPEED, j] = W[s.MODE, j] = 0.0


@compiled
def sensed(S: Array, W: Array, ring: Array, now: int, k: int, h: float, y: Array) -> None:
    """Row k of y: late, scaled, shifted."""
    n = W.shape[1]
    for j in range(2 * n):
        back = S[j, s.LATE] / h
        whole = int(back)
        late, earlier = (now - whole) & 4095, (now - whole - 1) & 4095
        value = ring[late, j] + (back - whole) * (ring[earlier, j] - ring[late, j])
        y[k, j] = S[j, s.SCALE] * value + S[j, s.BIAS]


@compiled
def imagine(S: Array, W: Array, ring: Array, now: int, h: float) -> None:
    """The past that late sensors show just after a reset: the parabola through the present."""
    n = W.shape[1]
    longest = 0.0
    for j in range(2 * n):
        longest = max(longest, S[j, s.LATE])
    for back in range(1, int(longest / h) + 3):
        t = back * h
        for j in range(n):
            ring[(now - back) & 4095, j] = W[s.NOW, j] - t * W[s.SPEED, j] + 0.5 * t * t * W[s.PULL, j]
            ring[(now - back) & 4095, n + j] = W[s.SPEED, j] - t * W[s.PULL, j]


@compiled
def commanded(u: Array, ticks: Ints, at: int, i: int, since: float, hold: int) -> float:
    """Mean command from `since` (in steps, after tick `at`) to a step later: held, or on straight lines; 0 before the first."""
    first = ticks[0] if since < ticks[0] - NEAR else ticks[min(at + 1, len(ticks) - 1)]
    before = 0.0 if since < ticks[0] - NEAR else u[at, i]
    after = u[0, i] if since < ticks[0] - NEAR else u[min(at + 1, len(u) - 1), i]
    if hold == 0 or since < ticks[0] - NEAR:
        late = min(max(since + 1 - first, 0.0), 1.0) if first > since else 0.0
        return float(before + late * (after - before))
    share = (since + 0.5 - ticks[at]) / max(first - ticks[at], 1)
    return float(before + min(share, 1.0) * (after - before))


@compiled
def remember(W: Array, ring: Array, now: int) -> None:
    n = W.shape[1]
    for j in range(n):
        ring[now & 4095, j], ring[now & 4095, n + j] = W[s.NOW, j], W[s.SPEED, j]


def simulate(machine: Machine, drive: Drive) -> tuple[Array, Array]:
    """(x, y): true states and sensed states (T, 2n) at the ticks."""
    (T, nu), n = drive.u.shape, len(machine.C)
    x, y, ring = np.empty((T, 2 * n)), np.empty((T, 2 * n)), np.zeros((4096, 2 * n))
    W, M = np.zeros((s.WORKSPACE, n)), np.zeros((2, n, n))
    memory, arrived, acting = np.zeros((nu, 4)), np.zeros(nu, dtype=np.int64), np.zeros(nu)
    march(machine, drive, x, y, ring, W, M, memory, arrived, acting)
    return x, y


@compiled
def march(
    machine: Machine,
    drive: Drive,
    x: Array,
    y: Array,
    ring: Array,
    W: Array,
    M: Array,
    memory: Array,
    arrived: Ints,
    acting: Array,
) -> None:
    """The loop of `simulate` over preallocated arrays."""
    A, ticks, h, u = machine.A, drive.ticks, drive.h, drive.u
    (T, nu), n = u.shape, W.shape[1]
    r, now = 0, ticks[0]
    for k in range(T):
        if r < len(drive.resets) and drive.resets[r] == k:
            for j in range(n):
                W[s.NOW, j], W[s.SPEED, j] = drive.starts[r, j], drive.starts[r, n + j]
            settle(machine.C, W)
            r += 1
            rates(machine, drive.disturbance[k], W, M, s.NOW, s.PULL, acting, now * h, True)
            imagine(machine.S, W, ring, now, h)
        remember(W, ring, now)
        for j in range(n):
            x[k, j], x[k, n + j] = W[s.NOW, j], W[s.SPEED, j]
        sensed(machine.S, W, ring, now, k, h, y)
        for i in range(nu):
            for j in range(2 * n):
                u[k, i] += drive.gains[i, j] * (drive.reference[k, j] - y[k, j])
            u[k, i] = min(max(u[k, i], -drive.limit[i]), drive.limit[i])
        while k + 1 < T and now < ticks[k + 1]:
            for i in range(nu):
                since = now - A[i, s.DELAY] / h
                while arrived[i] < k and ticks[arrived[i] + 1] <= since + NEAR:
                    arrived[i] += 1
                command = commanded(u, ticks, arrived[i], i, since, drive.hold)
                acting[i] = path(A, i, memory, command, h)
            advance(machine, drive, W, M, acting, k, now * h)
            now += 1
            remember(W, ring, now)
