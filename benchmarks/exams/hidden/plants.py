"""The systems that exams hide effects in: what is stated about them, and the equations that a user would write down."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

TOLERANCE = 0.02  # of every stated value


@final
@dataclass(frozen=True)
class Plant:
    """One system: `number` is its branch in `terms`, `stated` are its uncertain parameters with their units, in order.

    positions, velocities: names of the states; sites: of effects at coordinates (for a plain derivative the state equations);
    exact: lengths that are known; amplitude (nu,): of the inputs; band: in Hz, where it answers; gains (nu, 2n): a controller
    that tracks `reach` (n,); start (2n,): spread of initial states; room (n,): the range that positions may take; free:
    nothing pulls it back; hidden: what no sensor shows.
    """

    name: str
    number: int
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    sites: tuple[str, ...]
    inputs: tuple[str, ...]
    stated: Mapping[str, tuple[float, str]]
    exact: tuple[float, ...]
    amplitude: tuple[float, ...]
    band: tuple[float, float]
    gains: tuple[tuple[float, ...], ...]
    reach: tuple[float, ...]
    start: tuple[float, ...]
    room: tuple[float, ...]
    text: Mapping[str, Any] = field(default_factory=dict)
    free: bool = False
    hidden: tuple[str, ...] = ()

    @property
    def n(self) -> int:
        return len(self.positions)

    def section(self, period: float) -> dict[str, Any]:
        """The nominal model as its user states it, sampled every `period` s."""
        stated = {k: {"value": f"{v!r} {unit}", "tolerance": f"{100 * TOLERANCE:g} %"} for k, (v, unit) in self.stated.items()}
        text = dict(self.text)
        parameters = stated | text.pop("parameters", {})
        substeps = max(1, math.ceil(period / text.pop("substep", 0.005) - 1e-9))
        return {
            "kind": "equations",
            **text,
            "parameters": parameters,
            "integrator": "rk4",
            "substeps": substeps,
            "period": f"{period:g} s",
        }


ANGLE = {"unit": "rad", "kind": "angle"}
G = {"g": "9.81 m/s^2"}

PENDULUM = Plant(
    "pendulum",
    0,
    ("q",),
    ("q_dot",),
    ("q",),
    ("u",),
    {"m": (1.0, "kg"), "c": (0.5, "m"), "J": (0.09, "kg*m^2")},
    (1.0,),
    (3.0,),
    (0.2, 3.0),
    ((20.0, 3.0),),
    (1.0,),
    (1.2, 1.0),
    (3.0,),
    {
        "coordinates": {"q": ANGLE},
        "inputs": {"u": "N*m"},
        "parameters": {**G, "L": "1 m"},
        "mass_matrix": [["m*c**2 + J"]],
        "bias": {"q": "m*g*c*sin(q)"},
        "forces": {"q": "u"},
        "points": {"q": ["L*sin(q)", "-L*cos(q)"]},
    },
)

DRIVE = Plant(
    "drive",
    1,
    ("q",),
    ("q_dot",),
    ("q",),
    ("F",),
    {"mass": (4.0, "kg")},
    (),
    (20.0,),
    (0.3, 3.0),
    ((200.0, 40.0),),
    (0.5,),
    (0.2, 1.5),
    (6.0,),
    {
        "coordinates": {"q": "m"},
        "inputs": {"F": "N"},
        "mass_matrix": [["mass"]],
        "forces": {"q": "F"},
        "points": {"q": ["q", "0*q"]},
    },
    free=True,
)

CARTPOLE = Plant(
    "cartpole",
    2,
    ("x", "theta"),
    ("x_dot", "theta_dot"),
    ("x", "theta"),
    ("F",),
    {"M": (1.0, "kg"), "m": (0.3, "kg"), "c": (0.4, "m"), "J": (0.02, "kg*m^2")},
    (0.8,),
    (8.0,),
    (0.2, 3.0),
    ((30.0, 0.0, 12.0, 0.0),),
    (0.4, 0.0),
    (0.2, 1.0, 0.5, 1.5),
    (5.0, 3.0),
    {
        "coordinates": {"x": "m", "theta": ANGLE},
        "inputs": {"F": "N"},
        "parameters": {**G, "L": "0.8 m"},
        "mass_matrix": [["M + m", "m*c*cos(theta)"], ["m*c*cos(theta)", "m*c**2 + J"]],
        "bias": {"x": "-m*c*sin(theta)*theta_dot**2", "theta": "m*g*c*sin(theta)"},
        "forces": {"x": "F"},
        "points": {"x": ["x", "0*x"], "theta": ["x + L*sin(theta)", "-L*cos(theta)"]},
    },
    free=True,
)

ARM = Plant(
    "arm",
    3,
    ("q1", "q2"),
    ("q1_dot", "q2_dot"),
    ("q1", "q2"),
    ("u1", "u2"),
    {
        "m1": (1.2, "kg"),
        "m2": (0.8, "kg"),
        "l1": (0.5, "m"),
        "c1": (0.25, "m"),
        "c2": (0.22, "m"),
        "J1": (0.03, "kg*m^2"),
        "J2": (0.015, "kg*m^2"),
    },
    (0.45,),
    (6.0, 2.5),
    (0.2, 3.0),
    ((40.0, 0.0, 6.0, 0.0), (0.0, 15.0, 0.0, 2.0)),
    (0.9, 0.9),
    (0.8, 0.8, 1.0, 1.0),
    (2.5, 3.5),
    {
        "coordinates": {"q1": ANGLE, "q2": ANGLE},
        "inputs": {"u1": "N*m", "u2": "N*m"},
        "parameters": {**G, "L": "0.45 m"},
        "mass_matrix": [
            ["J1 + m1*c1**2 + J2 + m2*(l1**2 + c2**2 + 2*l1*c2*cos(q2))", "J2 + m2*(c2**2 + l1*c2*cos(q2))"],
            ["J2 + m2*(c2**2 + l1*c2*cos(q2))", "J2 + m2*c2**2"],
        ],
        "bias": {
            "q1": "-m2*l1*c2*sin(q2)*(2*q1_dot*q2_dot + q2_dot**2) + (m1*c1 + m2*l1)*g*sin(q1) + m2*c2*g*sin(q1 + q2)",
            "q2": "m2*l1*c2*sin(q2)*q1_dot**2 + m2*c2*g*sin(q1 + q2)",
        },
        "forces": {"q1": "u1", "q2": "u2"},
        "points": {
            "q1": ["l1*sin(q1)", "-l1*cos(q1)"],
            "q2": ["l1*sin(q1) + L*sin(q1 + q2)", "-l1*cos(q1) - L*cos(q1 + q2)"],
        },
    },
)

MOTOR = Plant(
    "motor",
    4,
    ("q", "charge"),
    ("w", "i"),
    ("w", "i"),
    ("V",),
    {"R": (1.0, "ohm"), "K": (0.5, "N*m/A"), "J": (0.025, "kg*m^2"), "Li": (0.01, "H")},
    (),
    (12.0,),
    (0.2, 4.0),
    ((25.0, 0.0, 1.0, 0.0),),
    (2.0, 0.0),
    (0.0, 0.0, 20.0, 0.0),
    (1e3, 1e3),
    {
        "states": {"q": "rad", "w": "rad/s", "i": "A"},
        "inputs": {"V": "V"},
        "derivative": {"q": "w", "w": "K*i/J", "i": "(V - R*i - K*w)/Li"},
        "substep": 0.0025,
    },
    hidden=("charge",),
)

BASE = Plant(
    "base",
    5,
    ("x", "y", "psi"),
    ("x_dot", "y_dot", "psi_dot"),
    ("x", "y", "psi"),
    ("Fx", "Fy", "T"),
    {"m": (20.0, "kg"), "J": (1.2, "kg*m^2"), "d": (12.0, "N*s/m"), "r": (0.8, "N*m*s/rad")},
    (),
    (40.0, 40.0, 3.0),
    (0.2, 2.0),
    ((150.0, 0.0, 0.0, 60.0, 0.0, 0.0), (0.0, 150.0, 0.0, 0.0, 60.0, 0.0), (0.0, 0.0, 12.0, 0.0, 0.0, 4.0)),
    (0.6, 0.6, 0.8),
    (0.3, 0.3, 0.5, 0.8, 0.8, 1.0),
    (1e3, 1e3, 1e3),
    {
        "coordinates": {"x": "m", "y": "m", "psi": ANGLE},
        "inputs": {"Fx": "N", "Fy": "N", "T": "N*m"},
        "mass_matrix": [["m", 0, 0], [0, "m", 0], [0, 0, "J"]],
        "bias": {"x": "d*x_dot", "y": "d*y_dot", "psi": "r*psi_dot"},
        "forces": {"x": "Fx*cos(psi) - Fy*sin(psi)", "y": "Fx*sin(psi) + Fy*cos(psi)", "psi": "T"},
    },
    free=True,
)

LENGTH, ROTOR, DAMPING = 0.25, 0.05, 0.1  # of every link and joint of the chain


def _chain(n: int) -> Plant:
    """n rods in a vertical plane, hanging, each driven against the one before; q is the angle between neighbours."""
    q = [f"q{i + 1}" for i in range(n)]
    mass = [round(1.4 - 0.15 * i, 3) for i in range(n)]
    names = [f"m{i + 1}" for i in range(n)]

    def inertia(i: int, j: int) -> str:
        """Of the absolute angles i ≤ j, over LENGTH²: half of rod j, and all that hang from it."""
        half = f"{names[j]}/3" if i == j else f"{names[j]}/2"
        return " + ".join([half, *names[j + 1 :]])

    def phi(i: int) -> str:
        return " + ".join(q[: i + 1])

    def between(i: int, j: int) -> str:
        return "1" if i == j else f"cos({' + '.join(q[min(i, j) + 1 : max(i, j) + 1])})"

    def entry(a: int, b: int) -> str:
        terms = [f"({inertia(min(i, j), max(i, j))})*{between(i, j)}" for i in range(a, n) for j in range(b, n)]
        return f"l**2*({' + '.join(terms)})" + (" + J" if a == b else "")

    def swing(a: int) -> str:
        """Σ_{i ≥ a} Σ_j A_ij sin(φ_i − φ_j) φ̇_j²."""
        terms = []
        for i, j in ((i, j) for i in range(a, n) for j in range(n) if i != j):
            sign = "" if i > j else "-"
            angle = " + ".join(q[min(i, j) + 1 : max(i, j) + 1])
            speed = " + ".join(f"{name}_dot" for name in q[: j + 1])
            terms.append(f"{sign}({inertia(min(i, j), max(i, j))})*sin({angle})*({speed})**2")
        return f"l**2*({' + '.join(terms)})"

    def weight(a: int) -> str:
        terms = [f"({' + '.join([f'{names[i]}/2', *names[i + 1 :]])})*sin({phi(i)})" for i in range(a, n)]
        return f"l*g*({' + '.join(terms)})"

    gains = tuple(tuple([60.0 * (i == j) for j in range(n)] + [6.0 * (i == j) for j in range(n)]) for i in range(n))
    return Plant(
        "chain",
        6,
        tuple(q),
        tuple(f"{name}_dot" for name in q),
        tuple(q),
        tuple(f"u{i + 1}" for i in range(n)),
        {name: (m, "kg") for name, m in zip(names, mass, strict=True)},
        (),
        tuple(round(10.0 * 0.75**i, 2) for i in range(n)),
        (0.2, 2.0),
        gains,
        (0.6,) * n,
        (0.4,) * n + (0.5,) * n,
        (3.0,) * n,
        {
            "coordinates": dict.fromkeys(q, ANGLE),
            "inputs": {f"u{i + 1}": "N*m" for i in range(n)},
            "parameters": {**G, "l": f"{LENGTH!r} m", "J": f"{ROTOR!r} kg*m^2", "b": f"{DAMPING!r} N*m*s/rad"},
            "mass_matrix": [[entry(a, b) for b in range(n)] for a in range(n)],
            "bias": {q[a]: f"{swing(a)} + {weight(a)} + b*{q[a]}_dot" for a in range(n)},
            "forces": {q[a]: f"u{a + 1}" for a in range(n)},
        },
    )


CHAIN = _chain(7)
PLANTS = {p.name: p for p in (PENDULUM, DRIVE, CARTPOLE, ARM, MOTOR, BASE, CHAIN)}
