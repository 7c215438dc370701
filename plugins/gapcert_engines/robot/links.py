"""The robot of a physics engine as rigid links on joints, and these as a section of an equations model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array

NATIVE = {"viscous-friction": ("damping",), "coulomb-friction": ("frictionloss", "coulomb_friction")}
"""What engines call the parameters that realise effects at a joint, `KIND.JOINT`."""
NATIVE_UNITS = {
    False: {"damping": "N*m*s/rad", "dry": "N*m", "armature": "kg*m^2", "stiffness": "N*m/rad", "rest": "rad"},
    True: {"damping": "N*s/m", "dry": "N", "armature": "kg", "stiffness": "N/m", "rest": "m"},
}
"""Of what joints have, by whether they slide."""

Vector = tuple[float, float, float]
Moments = tuple[float, float, float, float, float, float]
"""An inertia as xx, yy, zz, xy, xz, yz."""


@final
@dataclass(frozen=True)
class Link:
    """A rigid link and the joint that carries it; `parent` is a link before this one, None the world.

    Its frame is the joint's: at `place` (m) in the parent's frame, turned by the quaternion `turn` (w, x, y, z) at q = 0. In it
    stand the joint's `axis`, `com` (m) and `inertia` about com (xx, yy, zz, xy, xz, yz in kg·m²). `coordinate` turns it about
    the axis, or pushes it along the axis where the joint is `straight`; None: welded. `name` and `joint` are the engine's. The
    joint has inertia of its own (`armature`), `damping` and dry friction (`dry`), None where the engine has no such thing, and
    a spring that pulls it to `rest` (rad or m). Something else carries the share `lifted` of its weight. soft: (compliance,
    rate) of dry friction that gives way, None where it holds.
    The engine has its frame for the centre of mass at `origin` (m) and along the joint's axes, and calls this inertia `moment`
    (kg·m²), None where it has no parameter for that.
    """

    name: str
    parent: str | None = None
    place: Vector = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    coordinate: str | None = None
    joint: str = ""
    straight: bool = False
    axis: Vector = (0.0, 0.0, 1.0)
    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)
    inertia: Moments = (0.0,) * 6
    armature: float | None = None
    damping: float | None = None
    dry: float | None = None
    soft: tuple[float, float] | None = None
    stiffness: float = 0.0
    rest: float = 0.0
    lifted: float = 0.0
    origin: Vector = (0.0, 0.0, 0.0)
    moment: float | None = None


def moments(inertia: Array) -> Moments:
    """Of an inertia (3, 3)."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    return xx, yy, zz, xy, xz, yz


def largest_moment(xx: float, yy: float, zz: float, xy: float = 0.0, xz: float = 0.0, yz: float = 0.0) -> float:
    """The largest principal one."""
    return float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[-1])


def as_section(
    links: Sequence[Link],
    gravity: Vector,
    free: Mapping[str, str],
    *,
    implicit: bool,
    after: bool = False,
    springs: bool = True,
    integrator: str = "semi_implicit",
) -> dict[str, Any]:
    """`parameters`, `bodies`, `gravity`, `forces` and friction of the joints, and `integrator`.

    gravity in m/s²; free: native parameters (`mass.LINK`, `com_x.LINK`, `inertia.LINK`, `damping.JOINT`, `gravity_x`, …) →
    names of parameters that stand for their numbers; the inertia follows a mass that is free. implicit: with damping c and, of
    `springs`, stiffness k solved with the step of h seconds, (M + h (c + h k)) v̇ = forces − c v − k (q − rest + h v); dry
    friction does not feel them where it comes `after`.
    """
    values, bodies, forces, dry = _Values(free), dict[str, Any](), dict[str, str](), dict[str, str]()
    held, soft, h = dict[str, str](), dict[str, dict[str, float]](), _substep(links, free)
    for k, link in enumerate(links):
        body: dict[str, Any] = {"at": list(link.place), "turned": list(link.turn)} | values.inertia(link)
        if link.lifted:
            body["lifted"] = repr(link.lifted)
        if link.parent is not None:
            body["on"] = link.parent
        if (q := link.coordinate) is not None:
            armature, damping, stiffness, friction = (
                values.joint(link, k, what) for what in ("armature", "damping", "stiffness", "dry")
            )
            pulls, late = list[str](), list[str]()
            if damping is not None:
                pulls.append(f"-{damping}*{q}_dot")
                late.append(damping)
            if stiffness is not None:
                rest = values.joint(link, k, "rest")
                stretch = f"{q} - {rest}" if rest is not None else q
                held_too = implicit and springs
                pulls.append(f"-{stiffness}*({stretch} + {h}*{q}_dot)" if held_too else f"-{stiffness}*({stretch})")
                late += [f"{h}*{stiffness}"] if held_too else []
            if pulls:
                forces[q] = " ".join(pulls)
                held |= {q: " + ".join(late)} if implicit and late else {}
            if friction is not None:
                dry[q] = friction
            if link.soft is not None:
                soft[q] = dict(zip(("compliance", "rate"), link.soft, strict=True))
            body |= {"joint": q, "axis": list(link.axis), "armature": armature or 0.0}
        bodies[link.name] = body
    down = [free.get(f"gravity_{a}") or f"{g!r} m/s^2" for a, g in zip("xyz", gravity, strict=True)]
    return {
        "parameters": values.parameters,
        "bodies": bodies,
        "gravity": down,
        "forces": forces,
        **{name: part for name, part in (("dry_friction", dry), ("implicit", held), ("soft_friction", soft)) if part},
        **({"friction_after_damping": True} if after else {}),
        "integrator": integrator,
    }


def _substep(links: Sequence[Link], free: Mapping[str, str]) -> str:
    """What the equations call the sub-step, where a coordinate or a parameter has its name."""
    name, taken = "h", {*free.values(), *(link.coordinate for link in links)}
    while name in taken:
        name += "_"
    return name


class _Values:
    """Numbers of links as texts, or the parameters that stand for them."""

    def __init__(self, free: Mapping[str, str]) -> None:
        self.free = free
        self.parameters: dict[str, str] = {}

    def joint(self, link: Link, k: int, what: str) -> str | None:
        """The name of a joint's parameter, whose unit no number in an expression can say; None where it is zero."""
        number: float | None = getattr(link, what)
        kinds = NATIVE["coulomb-friction"] if what == "dry" else (what,)
        for kind in kinds:
            if (name := self.free.get(f"{kind}.{link.joint}")) is not None:
                return name
        return self._new(f"{what}_{k}", number, NATIVE_UNITS[link.straight][what]) if number else None

    def inertia(self, link: Link) -> dict[str, Any]:
        """Mass, centre and inertia, which follows a mass that is free."""
        mass, moment = (self.free.get(f"{what}.{link.name}") for what in ("mass", "inertia"))
        size, unit = 1.0, ""
        if moment is not None:
            assert link.moment is not None, "what is free is a parameter of the engine"
            size, unit = link.moment, f"*{moment}"
        if mass is not None:
            square, per = f"*{self._one('metre')}**2", f"/{self._one('kilogram')}"
            size, unit = size * link.mass, f"{unit}*{mass}{square if moment is None else per}"
        texts = [f"{e / size!r}{unit}" if e else "0.0" for e in link.inertia]
        return {"mass": mass or repr(link.mass), "com": [self._centre(link, k) for k in range(3)], "inertia": texts}

    def _centre(self, link: Link, k: int) -> float | str:
        if (name := self.free.get(f"com_{'xyz'[k]}.{link.name}")) is None:
            return link.com[k]
        return f"{name} + {link.origin[k]!r}*{self._one('metre')}" if link.origin[k] else name

    def _one(self, unit: str) -> str:
        """A parameter that is 1 of a unit."""
        self.parameters.setdefault(unit, f"1 {unit}")
        return unit

    def _new(self, name: str, number: float, unit: str) -> str:
        while name in self.free.values():
            name += "_"
        self.parameters[name] = f"{number!r} {unit}"
        return name
