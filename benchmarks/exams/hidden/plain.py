"""Plants written as plain derivatives, by another hand: motors, wheels, heaters, tanks, valves, circuits, struts, cascades.

Nothing here comes from equation text: derivatives are written out and compiled, and take Runge–Kutta steps far shorter than the
fastest time constant. Dry friction stops a speed within the step that it can. Delays are exact means over these steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from exams.hidden.laws import Hidden
from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.kernels import compiler

compiled = compiler(error_model="numpy")

VISCOUS, QUADRATIC, DRY, CONSTANT, PUSH, WHEN, LONG = range(7)
GAIN, OFFSET, MINUS, PLUS, HARD, SOFT, DELAY, LAG, RATE, SAG, SAG_TIME, SECOND, SQUARE, CUBE, RATIO, SHARPNESS = range(16)
SCALE, BIAS, LATE, SLOW = range(4)
WINDOW, RUN = 1, 2  # what begins at a sample: a rollout, or a run with all its memories
STEPS = 12  # in the fastest time constant, and in a sample, at least


@compiled
def derivative(number: int, p: Array, x: Array, a: float, d: Array) -> None:
    if number == 0:  # motor: speed, current
        d[0] = (p[2] * x[1] - p[4] * x[0]) / p[3]
        d[1] = (a - p[0] * x[1] - p[2] * x[0]) / p[1]
    elif number == 1:  # wheel
        d[0] = (p[0] * a - x[0]) / p[1]
    elif number == 2:  # heater
        d[0] = (a - p[1] * (x[0] - p[2])) / p[0]
    elif number == 3:  # tank
        d[0] = (a - p[1] * math.sqrt(2 * p[2] * max(x[0], 0.0))) / p[0]
    elif number == 4:  # cylinder behind a valve: position, speed
        d[0] = x[1]
        d[1] = (p[0] * a * math.sqrt(1 - p[2] * math.tanh(a / p[3])) - x[1]) / p[1]
    elif number == 5:  # rc
        d[0] = (a - x[0]) / (p[0] * p[1])
    elif number == 6:  # rlc: voltage, current
        d[0] = x[1] / p[2]
        d[1] = (a - p[0] * x[1] - x[0]) / p[1]
    elif number == 7:  # strut
        d[0] = a
    elif number == 9:  # tanks, the first of which runs into the second
        flow = p[2] * math.sqrt(2 * p[4] * max(x[0], 0.0))
        d[0] = (a - flow) / p[0]
        d[1] = (flow - p[3] * math.sqrt(2 * p[4] * max(x[1], 0.0))) / p[1]
    elif number == 10:  # oven: heating element, chamber
        d[0] = (a - p[2] * (x[0] - x[1])) / p[0]
        d[1] = (p[2] * (x[0] - x[1]) - p[3] * (x[1] - p[4])) / p[1]
    else:  # twin: speeds of motor and load, twist
        shaft = p[3] * x[2] + p[4] * (x[0] - x[1])
        d[0] = (a - shaft - p[2] * x[0]) / p[0]
        d[1] = shaft / p[1]
        d[2] = x[0] - x[1]


@compiled
def output(number: int, p: Array, x: Array, a: float, y: Array) -> None:
    for j in range(len(x)):
        y[j] = x[j]
    if number == 7:
        y[1] = p[0] * x[0] + p[1] * a + p[2] * math.tanh(a / p[3])


@compiled
def slope(number: int, p: Array, F: Array, x: Array, a: float, t: float, h: float, d: Array) -> None:
    derivative(number, p, x, a, d)
    for j in range(len(x)):
        row = F[j]
        pushed = max(0.0, min(t + h, row[WHEN] + row[LONG]) - max(t, row[WHEN])) / h
        d[j] += row[CONSTANT] + row[PUSH] * pushed - (row[VISCOUS] + row[QUADRATIC] * abs(x[j])) * x[j]


@compiled
def path(W: Array, memory: Array, a: float, h: float) -> float:
    """What acts, on average over a step, of what was commanded."""
    a = max(a - W[PLUS], 0.0) + W[RATIO] * min(a + W[MINUS], 0.0)
    a += W[SQUARE] * a**2 + W[CUBE] * a**3
    if W[RATE] > 0:
        moved = min(max(a - memory[0], -W[RATE] * h), W[RATE] * h)
        a = memory[0] + 0.5 * moved
        memory[0] += moved
    if W[LAG] > 0:
        now = a + (memory[1] - a) * math.exp(-h / W[LAG])
        a, memory[1] = 0.5 * (memory[1] + now), now
    if W[SECOND] > 0:
        now = a + (memory[3] - a) * math.exp(-h / W[SECOND])
        a, memory[3] = 0.5 * (memory[3] + now), now
    if W[SAG] > 0:
        now = abs(a) + (memory[2] - abs(a)) * math.exp(-h / W[SAG_TIME])
        a, memory[2] = a * (1 - 0.5 * W[SAG] * (memory[2] + now)), now
    a = W[GAIN] * a + W[OFFSET]
    if W[HARD] > 0 and W[SHARPNESS] > 0:
        a /= (1 + abs(a / W[HARD]) ** W[SHARPNESS]) ** (1 / W[SHARPNESS])
    elif W[HARD] > 0:
        a = min(max(a, -W[HARD]), W[HARD])
    if W[SOFT] > 0:
        a = W[SOFT] * math.tanh(a / W[SOFT])
    return a


@compiled
def commanded(u: Array, first: int, sub: int, at: float, straight: bool, before: float) -> float:
    """The input at a time in steps, or over the step that begins there where inputs are held; `before` the run began."""
    n = math.floor(at / sub if straight else at)
    part = (at / sub if straight else at) - n
    a, b = (n, n + 1) if straight else (n // sub, (n + 1) // sub)
    if straight and a < first:
        return before
    here = before if a < first else u[a]
    then = before if b < first else u[min(b, len(u) - 1)]
    return (1 - part) * here + part * then


@compiled
def simulate(
    number: int,
    p: Array,
    F: Array,
    W: Array,
    S: Array,
    u: Array,
    noise: Array,
    reference: Array,
    law: Array,
    period: float,
    sub: int,
    straight: bool,
    begins: Ints,
    starts: Array,
    before: Array,
) -> tuple[Array, Array]:
    """(states, sensed outputs without noise) at the samples.

    u is written where a controller acts; law: its three gains, the middle and half the range of its input, its output or −1.
    before: what was commanded before each run.
    """
    n, count, h = starts.shape[1], len(u), period / sub
    ny = len(S)
    X, Y, fine = np.zeros((count, n)), np.zeros((count, ny)), np.zeros((count * sub, ny))
    x, z, d, kept = np.zeros(n), np.zeros(n), np.zeros((4, n)), np.zeros(4)
    memory, first, begun, total, last, run, old = np.zeros(4), 0, 0, 0.0, 0.0, 0, 0.0
    here, there = np.zeros(ny), np.zeros(ny)
    for k in range(count):
        if begins[k] > 0:
            x[:] = starts[begun]
            begun += 1
            if begins[k] == RUN:
                old = before[run]
                run += 1
                memory[:], first, total = old, k, 0.0
                memory[2] = abs(old)
        X[k] = x
        for j in range(sub):
            now = k * sub + j
            held = commanded(u, first, sub, now - W[DELAY] / h, straight, old)
            kept[:] = memory
            output(number, p, x, path(W, kept, held, 1e-9 * h), here)
            for i in range(ny):
                fine[now, i] = here[i]
                if S[i, SLOW] > 0 and now > first * sub:
                    left = math.exp(-h / S[i, SLOW])
                    fine[now, i] = left * fine[now - 1, i] + (1 - left) * (here[i] + there[i]) / 2
            there[:] = here
            if j == 0:
                for i in range(ny):
                    at = max(now - S[i, LATE] / h, float(first * sub))
                    b = math.floor(at)
                    shown = fine[b, i] + (at - b) * (fine[min(b + 1, now), i] - fine[b, i])
                    Y[k, i] = S[i, SCALE] * shown + S[i, BIAS]
                if law[5] >= 0:
                    seen = Y[k, int(law[5])] + noise[k]
                    error = reference[k] - seen
                    rate = 0.0 if k == first else (last - seen) / period
                    asked = law[3] + law[0] * error + total + law[2] * rate
                    u[k] = min(max(asked, law[3] - law[4]), law[3] + law[4])
                    if asked == u[k]:
                        total += law[1] * error * period
                    last = seen
            middle = 0.5 if straight else 0.0
            a = path(W, memory, commanded(u, first, sub, now + middle - W[DELAY] / h, straight, old), h)
            t = (now - first * sub) * h
            z[:] = x
            for s in range(4):
                slope(number, p, F, z, a, t, h, d[s])
                for i in range(n):
                    z[i] = x[i] + (h if s == 2 else 0.5 * h) * d[s, i]
            for i in range(n):
                x[i] += h / 6 * (d[0, i] + 2 * d[1, i] + 2 * d[2, i] + d[3, i])
                if F[i, DRY] > 0:
                    x[i] = math.copysign(max(abs(x[i]) - F[i, DRY] * h, 0.0), x[i])
                x[i] = min(max(x[i], -1e9), 1e9)
    return X, Y


@final
@dataclass(frozen=True)
class Plant:
    """How a plant is stated, and how one is drawn.

    values: name → (value, unit, is it known only roughly?); times: slowest and fastest time constants; middle, peak: of its
    input; views: what may be measured; sites: where something moves; pushed: where a force may act; loop: output over input of
    a slow motion, 0 where nothing is controlled; rest: the state at the middle.
    """

    name: str
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    derivative: Mapping[str, str]
    values: Mapping[str, tuple[float, str, bool]]
    times: tuple[float, float]
    middle: float
    peak: float
    views: tuple[tuple[str, ...], ...]
    sites: tuple[str, ...] = ()
    pushed: tuple[str, ...] = ()
    loop: float = 0.0
    rest: tuple[float, ...] = (0.0,)
    outputs: Mapping[str, str] | None = None
    hold: Literal["zero", "first"] = "zero"

    @property
    def shown(self) -> tuple[str, ...]:
        return tuple(self.outputs or self.states)


NAMES = ("motor", "wheel", "heater", "tank", "cylinder", "rc", "rlc", "strut", "twin", "tanks", "oven")


def plant(name: str, rng: np.random.Generator) -> Plant:
    """One plant of a kind, with numbers of its own."""

    def drawn(low: float, high: float) -> float:
        return float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.4g}")

    if name == "motor":
        R, K, fast, slow = drawn(0.5, 5), drawn(0.02, 0.2), drawn(1e-3, 0.02), drawn(0.06, 0.3)
        values = {
            "R": (R, "ohm", True),
            "L": (R * fast, "H", True),
            "K": (K, "N*m/A", True),
            "J": (slow * K**2 / R, "kg*m^2", True),
            "b": (drawn(0.03, 0.2) * K**2 / R, "N*m*s/rad", True),
        }
        return Plant(
            name,
            {"w": "rad/s", "i": "A"},
            {"V": "V"},
            {"w": "(K*i - b*w)/J", "i": "(V - R*i - K*w)/L"},
            values,
            (slow, fast),
            0.0,
            12.0,
            (("w",), ("i",), ("w", "i")),
            ("w",),
            ("w",),
            1 / K,
            (0.0, 0.0),
        )
    if name == "wheel":
        K, slow = drawn(0.1, 0.5), drawn(0.06, 0.4)
        values = {"K": (K, "m/s/V", True), "tau": (slow, "s", True)}
        return Plant(
            name,
            {"v": "m/s"},
            {"u": "V"},
            {"v": "(K*u - v)/tau"},
            values,
            (slow, slow),
            0.0,
            10.0,
            (("v",),),
            ("v",),
            ("v",),
            K,
        )
    if name == "heater":
        C, slow = drawn(5, 60), drawn(80, 400)
        values = {"C": (C, "J/K", True), "U": (C / slow, "W/K", True), "Ta": (293.0, "K", False)}
        middle = drawn(15, 40) * C / slow
        return Plant(
            name,
            {"T": "K"},
            {"P": "W"},
            {"T": "(P - U*(T - Ta))/C"},
            values,
            (slow, slow),
            middle,
            middle,
            (("T",),),
            (),
            ("T",),
            slow / C,
            (293.0 + middle * slow / C,),
        )
    if name == "tank":
        A, level, slow = drawn(0.05, 0.5), drawn(0.4, 1.0), drawn(40, 200)
        flow = 2 * level * A / slow
        values = {"A": (A, "m^2", True), "a": (flow / math.sqrt(2 * 9.81 * level), "m^2", True), "g": (9.81, "m/s^2", False)}
        return Plant(
            name,
            {"h": "m"},
            {"q": "m^3/s"},
            {"h": "(q - a*sqrt(2*g*max(h, 0)))/A"},
            values,
            (slow, slow),
            flow,
            0.4 * flow,
            (("h",),),
            (),
            ("h",),
            slow / A,
            (level,),
        )
    if name == "cylinder":
        k, slow = drawn(0.02, 0.1), drawn(0.04, 0.2)
        values = {"k": (k, "m/s/V", True), "tau": (slow, "s", True), "r": (drawn(0.2, 0.6), "1", True), "us": (1.0, "V", False)}
        return Plant(
            name,
            {"y": "m", "v": "m/s"},
            {"u": "V"},
            {"y": "v", "v": "(k*u*sqrt(1 - r*tanh(u/us)) - v)/tau"},
            values,
            (3 * slow, slow),
            0.0,
            5.0,
            (("y",), ("y", "v")),
            (),
            ("v",),
            8 * k * slow,
            (0.0, 0.0),
        )
    if name == "rc":
        R, slow = drawn(1e3, 1e5), drawn(5e-3, 0.1)
        values = {"R": (R, "ohm", True), "C": (slow / R, "F", True)}
        return Plant(
            name, {"vc": "V"}, {"u": "V"}, {"vc": "(u - vc)/(R*C)"}, values, (slow, slow), 0.0, 5.0, (("vc",),), loop=1.0
        )
    if name == "rlc":
        w, z, C = 2 * math.pi * drawn(2, 20), drawn(0.1, 0.7), drawn(1e-5, 1e-3)
        L = 1 / (w**2 * C)
        values = {"R": (2 * z * w * L, "ohm", True), "L": (L, "H", True), "C": (C, "F", True)}
        return Plant(
            name,
            {"vc": "V", "i": "A"},
            {"u": "V"},
            {"vc": "i/C", "i": "(u - R*i - vc)/L"},
            values,
            (1 / (z * w), 1 / w),
            0.0,
            5.0,
            (("vc",), ("i",), ("vc", "i")),
            loop=1.0,
            rest=(0.0, 0.0),
        )
    if name == "strut":
        force = drawn(50, 5000)
        values = {
            "k": (force * drawn(3, 30), "N/m", True),
            "c": (force * drawn(2, 10), "N*s/m", True),
            "Fc": (force * drawn(0.2, 1), "N", True),
            "vs": (drawn(0.01, 0.05), "m/s", False),
        }
        text = {"x": "x", "F": "k*x + c*v + Fc*tanh(v/vs)"}
        return Plant(
            name,
            {"x": "m"},
            {"v": "m/s"},
            {"x": "v"},
            values,
            (drawn(0.1, 0.4), 0.05),
            0.0,
            0.15,
            (("F",), ("x", "F")),
            outputs=text,
            hold="first",
        )
    if name == "tanks":
        A, level, slow, lower, later = drawn(0.05, 0.5), drawn(0.4, 1.0), drawn(40, 200), drawn(0.4, 1.0), drawn(40, 200)
        flow = 2 * level * A / slow
        out = {"a1": flow / math.sqrt(2 * 9.81 * level), "a2": flow / math.sqrt(2 * 9.81 * lower)}
        values = {"A1": (A, "m^2", True), "A2": (flow * later / (2 * lower), "m^2", True)}
        values |= {n: (v, "m^2", True) for n, v in out.items()} | {"g": (9.81, "m/s^2", False)}
        between = "a1*sqrt(2*g*max(h1, 0))"
        return Plant(
            name,
            {"h1": "m", "h2": "m"},
            {"q": "m^3/s"},
            {"h1": f"(q - {between})/A1", "h2": f"({between} - a2*sqrt(2*g*max(h2, 0)))/A2"},
            values,
            (max(slow, later), min(slow, later)),
            flow,
            0.4 * flow,
            (("h1", "h2"), ("h2",)),
            pushed=("h1", "h2"),
            loop=slow / A,
            rest=(level, lower),
        )
    if name == "oven":
        C, slow, part, fast = drawn(5, 60), drawn(100, 400), drawn(0.1, 0.4), drawn(5, 30)
        U, k = C / slow, part * C / fast
        values = {"C1": (part * C, "J/K", True), "C2": (C, "J/K", True), "k": (k, "W/K", True), "U": (U, "W/K", True)}
        values |= {"Ta": (293.0, "K", False)}
        middle = drawn(15, 40) * U
        warm = 293.0 + middle / U
        return Plant(
            name,
            {"T1": "K", "T2": "K"},
            {"P": "W"},
            {"T1": "(P - k*(T1 - T2))/C1", "T2": "(k*(T1 - T2) - U*(T2 - Ta))/C2"},
            values,
            (slow, fast),
            middle,
            middle,
            (("T1", "T2"), ("T2",)),
            pushed=("T1", "T2"),
            loop=1 / U + 1 / k,
            rest=(warm + middle / k, warm),
        )
    J, part, slow, w, z = drawn(1e-4, 1e-2), drawn(0.3, 3), drawn(0.2, 0.8), 2 * math.pi * drawn(4, 15), drawn(0.03, 0.15)
    inner = J * part / (1 + part)
    values = {
        "J1": (J, "kg*m^2", True),
        "J2": (part * J, "kg*m^2", True),
        "b": (J * (1 + part) / slow, "N*m*s/rad", True),
        "k": (inner * w**2, "N*m/rad", True),
        "d": (2 * z * w * inner, "N*m*s/rad", True),
    }
    shaft = "k*tw + d*(w1 - w2)"
    return Plant(
        name,
        {"w1": "rad/s", "w2": "rad/s", "tw": "rad"},
        {"T": "N*m"},
        {"w1": f"(T - ({shaft}) - b*w1)/J1", "w2": f"({shaft})/J2", "tw": "w1 - w2"},
        values,
        (slow, 1 / w),
        0.0,
        30 * values["b"][0],
        (("w1",), ("w1", "w2")),
        ("w1", "w2"),
        ("w1", "w2"),
        1 / values["b"][0],
        (0.0, 0.0, 0.0),
    )


@final
@dataclass(frozen=True)
class Rig:
    """A plant with its true numbers and those it is stated to have, as it is played and measured.

    u (T,), reference (T,), noise (T, ny) in the outputs' units, begins (T,), starts (runs, nx); view: measured
    outputs; colour: lag-1 autocorrelation of the noise.
    """

    plant: Plant
    true: Array
    stated: Array
    tolerance: float
    period: float
    sub: int
    u: Array
    reference: Array
    law: Array
    noise: Array
    begins: Ints
    starts: Array
    view: tuple[str, ...]
    horizon: float
    excitation: str
    hold: Literal["zero", "first"]
    colour: float

    @property
    def section(self) -> dict[str, Any]:
        """The nominal model."""
        p, stated = self.plant, dict(zip(self.plant.values, self.stated, strict=True))
        loose = {"tolerance": f"{100 * self.tolerance:g} %"}
        values = {
            n: {"value": f"{float(stated[n])!r} {u}", **(loose if rough else {})} for n, (_, u, rough) in p.values.items()
        }
        more = {"outputs": dict(p.outputs)} if p.outputs else {}
        return {
            "kind": "equations",
            "states": dict(p.states),
            "inputs": dict(p.inputs),
            "parameters": values,
            "derivative": dict(p.derivative),
            "period": self.period,
            **more,
        }

    @property
    def columns(self) -> list[int]:
        return [self.plant.shown.index(n) for n in self.view]

    def play(self, effects: Sequence[Hidden] = (), noisy: bool = True) -> tuple[Array, Array, Array]:
        """(states, noiseless outputs, commands) of the machine with its effects."""
        u, noise = self.u.copy(), self.noise if noisy else 0 * self.noise
        x, y = self._run(effects, self.true, u, noise, self.law, self.begins, self.starts)
        return x, y, u

    def replay(
        self, effects: Sequence[Hidden], p: Array, u: Array, begins: Ints, starts: Array, before: Array | None = None
    ) -> Array:
        """Outputs (T, ny) under recorded inputs, and under what had been commanded before each run."""
        idle = np.array([0.0, 0, 0, self.plant.middle, 0, -1])
        return self._run(effects, p, u.copy(), 0 * self.noise, idle, begins, starts, before)[1]

    def _run(
        self,
        effects: Sequence[Hidden],
        p: Array,
        u: Array,
        noise: Array,
        law: Array,
        begins: Ints,
        starts: Array,
        before: Array | None = None,
    ) -> tuple[Array, Array]:
        p, F, W, S = tables(self.plant, p, effects)
        sub = self.sub * (3 if F[:, DRY].any() else 1)
        seen = noise[:, max(int(law[5]), 0)]
        straight, number = self.hold == "first", NAMES.index(self.plant.name)
        before = np.full((begins == RUN).sum(), law[3]) if before is None else before
        x, y = simulate(number, p, F, W, S, u, seen, self.reference, law, self.period, sub, straight, begins, starts, before)
        return x, y


_FORCES = {
    "viscous-friction": {"coefficient": VISCOUS},
    "quadratic-drag": {"coefficient": QUADRATIC},
    "coulomb-friction": {"level": DRY},
    "constant-force": {"force": CONSTANT},
    "external-push": {"force": PUSH, "time": WHEN, "duration": LONG},
}
_INPUTS = {
    "input-gain": {"gain": GAIN},
    "input-offset": {"offset": OFFSET},
    "input-dead-zone": {"minus": MINUS, "plus": PLUS, "ratio": RATIO},
    "input-nonlinearity": {"square": SQUARE, "cube": CUBE},
    "input-saturation": {"level": HARD, "sharpness": SHARPNESS},
    "input-saturation-soft": {"level": SOFT},
    "input-delay": {"delay": DELAY},
    "input-lag": {"time_constant": LAG, "second": SECOND},
    "input-rate-limit": {"rate": RATE},
    "supply-sag": {"sag": SAG, "time_constant": SAG_TIME},
}
_OUTPUTS = {
    "sensor-scale": {"scale": SCALE},
    "sensor-bias": {"bias": BIAS},
    "sensor-delay": {"delay": LATE},
    "sensor-lag": {"time_constant": SLOW},
}


def tables(plant: Plant, p: Array, effects: Sequence[Hidden]) -> tuple[Array, Array, Array, Array]:
    """(parameters, forces, input path, outputs) with the effects in them; KeyError where one is not known or has no place."""
    if len({h.key for h in effects}) < len(effects):
        raise KeyError("two laws of one effect")
    p, F, W, S = p.copy(), np.zeros((len(plant.states), 7)), np.zeros(16), np.zeros((len(plant.shown), 4))
    W[GAIN] = W[RATIO] = S[:, SCALE] = 1.0
    for h in effects:
        numbers = {"minus": h.numbers["width"], "plus": h.numbers["width"]} if "width" in h.numbers else dict(h.numbers)
        name = h.effect + ("-soft" if numbers.pop("soft", 0.0) else "")
        if h.effect == "parameter":
            p[tuple(plant.values).index(h.site)] = numbers["value"]
        else:
            slots = (_FORCES | _INPUTS | _OUTPUTS)[name]
            row = (
                F[tuple(plant.states).index(h.site)]
                if name in _FORCES
                else W
                if name in _INPUTS
                else S[plant.shown.index(h.site)]
            )
            for n, v in numbers.items():
                row[slots[n]] = v
    return p, F, W, S
