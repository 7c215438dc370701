"""The same plants as robots in physics engines, with effects put in from outside: into forces, inputs, outputs and the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from exams.hidden import slots as s
from exams.hidden.laws import Hidden, Tables
from exams.hidden.outside import Outside
from exams.hidden.plants import Plant
from exams.hidden.rig import Motion, Rig
from exams.hidden.terms import bias
from gapcert.contracts.plugins.component import Context
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.system import System
from gapcert.numerics.arrays import Array

STEP = 5e-4  # s
THIN = 1e-3  # kg·m² about a link's own axis, which no motion here turns

# Mass, its centre below the joint, inertia about that, kind of joint, joint below the parent's.
Link = tuple[float, float, float, str, float]


def links(plant: Plant, tables: Tables) -> list[Link]:
    """The bodies of a plant, payloads included."""
    p, exact = tables.parameters.tolist(), plant.exact
    load = tables.coordinates[:, s.PAYLOAD].tolist()

    def laden(mass: float, centre: float, inertia: float, extra: float, at: float) -> tuple[float, float, float]:
        total = mass + extra
        middle = (mass * centre + extra * at) / total
        return total, middle, inertia + mass * (centre - middle) ** 2 + extra * (at - middle) ** 2

    if plant.name == "pendulum":
        return [(*laden(p[0], p[1], p[2], load[0], exact[0]), "revolute", 0.0)]
    if plant.name == "drive":
        return [(p[0] + load[0], 0.0, 1.0, "prismatic", 0.0)]
    if plant.name == "cartpole":
        pole = laden(p[1], p[2], p[3], load[1], exact[0])
        return [(p[0] + load[0], 0.0, 1.0, "prismatic", 0.0), (*pole, "revolute", 0.0)]
    upper, lower = laden(p[0], p[3], p[5], load[0], p[2]), laden(p[1], p[4], p[6], load[1], exact[0])
    return [(*upper, "revolute", 0.0), (*lower, "revolute", p[2])]


def urdf(bodies: list[Link]) -> str:
    """Joints j0, j1, …: turning about −y, or sliding along x; links hang down."""
    parts = ['<robot name="plant"><link name="world"/>']
    parent = "world"
    for i, (mass, centre, inertia, kind, below) in enumerate(bodies):
        axis = "1 0 0" if kind == "prismatic" else "0 -1 0"
        turning = "continuous" if kind == "revolute" else "prismatic"
        limit = '<limit lower="-1000" upper="1000" effort="100000" velocity="100000"/>' if kind == "prismatic" else ""
        moments = f'ixx="{inertia!r}" ixy="0" ixz="0" iyy="{inertia!r}" iyz="0" izz="{THIN}"'
        origin = f'<origin xyz="0 0 {-centre!r}"/>'
        parts += [
            f'<link name="l{i}"><inertial>{origin}<mass value="{mass!r}"/><inertia {moments}/></inertial></link>',
            f'<joint name="j{i}" type="{turning}"><parent link="{parent}"/><child link="l{i}"/>{limit}',
            f'<origin xyz="0 0 {-below!r}"/><axis xyz="{axis}"/></joint>',
        ]
        parent = f"l{i}"
    return "\n".join([*parts, "</robot>"])


def sdf(bodies: list[Link]) -> str:
    """The same as a world of Gazebo."""
    parts = ['<sdf version="1.9"><world name="plant"><gravity>0 0 -9.81</gravity><model name="plant">']
    parent, height = "world", 0.0
    for i, (mass, centre, inertia, kind, below) in enumerate(bodies):
        height -= below
        axis = "1 0 0" if kind == "prismatic" else "0 -1 0"
        moments = f"<ixx>{inertia!r}</ixx><iyy>{inertia!r}</iyy><izz>{THIN}</izz>"
        pose = f"<pose>0 0 {-centre!r} 0 0 0</pose>"
        limit = "<limit><lower>-1000</lower><upper>1000</upper></limit>" if kind == "prismatic" else ""
        parts += [
            f'<link name="l{i}"><pose>0 0 {height!r} 0 0 0</pose><inertial>{pose}<mass>{mass!r}</mass>',
            f"<inertia>{moments}</inertia></inertial></link>",
            f'<joint name="j{i}" type="{kind}"><parent>{parent}</parent><child>l{i}</child>',
            f"<axis><xyz>{axis}</xyz>{limit}</axis></joint>",
        ]
        parent = f"l{i}"
    return "\n".join([*parts, "</model></world></sdf>"])


def backend(engine: str, plant: Plant, tables: Tables, folder: Path) -> System:
    """A plant in an engine without damping of its own, stepped by STEP; its file is written into `folder`."""
    bodies = links(plant, tables)
    file = folder / ("plant.sdf" if engine == "gazebo" else "plant.urdf")
    file.write_text(sdf(bodies) if engine == "gazebo" else urdf(bodies))
    driven = range(len(plant.inputs))
    section: dict[str, Any] = {
        "kind": engine,
        "robot": str(file),
        "states": {q: f"j{i}.position" for i, q in enumerate(plant.positions)}
        | {v: f"j{i}.velocity" for i, v in enumerate(plant.velocities)},
        "inputs": {plant.inputs[i]: f"j{i}" for i in driven},
        "period": f"{STEP} s",
    }
    if engine == "pybullet":
        section |= {"linear_damping": 0, "angular_damping": 0}
    known = registry()
    config: Any = known.config("backend", engine)
    system: System = known.build("backend", engine, config.model_validate(section), Context(folder))
    return system


def play(engine: str, rig: Rig, effects: tuple[Hidden, ...], folder: Path) -> Motion:
    """The motion of a rig in an engine; forces from outside are held for one step of it."""
    tables = Tables.of(rig.plant, rig.parameters).hide(effects)
    outside = Outside(backend(engine, rig.plant, tables, folder), tables)
    level = tables.coordinates.copy()
    level[:, s.TILT] = 0.0
    W, exact = np.zeros((s.WORKSPACE, rig.plant.n)), np.array([*rig.plant.exact, 0.0])

    def tilted(x: Array) -> Array:
        """What turned gravity adds."""
        W[: s.SPEED + 1] = x.reshape(2, -1)
        bias(rig.plant.number, tables.parameters, exact, level, W, s.NOW)
        force = W[s.BIASED].copy()
        bias(rig.plant.number, tables.parameters, exact, tables.coordinates, W, s.NOW)
        return np.asarray(force - W[s.BIASED])

    turned = tilted if np.any(tables.coordinates[:, s.TILT]) else None

    def command(k: int, y: Array) -> Array:
        return np.asarray(np.clip(rig.u[k] + rig.gains @ (rig.reference[k] - y), -rig.limit, rig.limit))

    x, y, u = outside.run(rig.start, command, len(rig.u), round(rig.period / STEP), turned)
    return Motion(np.asarray(np.arange(len(u)) * rig.period, dtype=np.float64), x, y, u)
