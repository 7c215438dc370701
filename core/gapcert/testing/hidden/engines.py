"""The same plants as robots in physics engines, with effects put in from outside: into forces, inputs, outputs and the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gapcert.components import Context, registry
from gapcert.system import System
from gapcert.testing.hidden import slots as s
from gapcert.testing.hidden.laws import Hidden, Tables
from gapcert.testing.hidden.motion import bound, bristles, dry, law, path
from gapcert.testing.hidden.rig import Motion, Rig
from gapcert.testing.hidden.slots import Array
from gapcert.testing.hidden.terms import bias

STEP = 5e-4  # s
THIN = 1e-3  # kg·m² about a link's own axis, which no motion here turns

Link = tuple[
    float, float, float, str, float
]  # mass, distance of its centre below the joint, inertia, joint, joint below parent's


def links(tables: Tables) -> list[Link]:
    """The bodies of a plant, payloads included."""
    p, exact = tables.parameters.tolist(), tables.plant.exact
    load = tables.coordinates[:, s.PAYLOAD].tolist()

    def laden(mass: float, centre: float, inertia: float, extra: float, at: float) -> tuple[float, float, float]:
        total = mass + extra
        middle = (mass * centre + extra * at) / total
        return total, middle, inertia + mass * (centre - middle) ** 2 + extra * (at - middle) ** 2

    if tables.plant.name == "pendulum":
        return [(*laden(p[0], p[1], p[2], load[0], exact[0]), "revolute", 0.0)]
    if tables.plant.name == "drive":
        return [(p[0] + load[0], 0.0, 1.0, "prismatic", 0.0)]
    if tables.plant.name == "cartpole":
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


def backend(engine: str, tables: Tables, folder: Path) -> System:
    """A plant in an engine without damping of its own, stepped by STEP; its file is written into `folder`."""
    plant, bodies = tables.plant, links(tables)
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
    tables = Tables(rig.plant, rig.parameters).hide(effects)
    system = backend(engine, tables, folder)
    outside = _Outside(rig, tables, system)
    n, u, every = rig.plant.n, rig.u.copy(), round(rig.period / STEP)
    x, hidden = rig.start.copy(), None
    fine, states, shown = [x], [], []
    for k in range(len(u)):
        y = outside.sensed(fine)
        states.append(x)
        shown.append(y)
        u[k] = np.clip(u[k] + rig.gains @ (rig.reference[k] - y), -rig.limit, rig.limit)
        for i in range(every if k + 1 < len(u) else 0):
            acting, forces = outside.act(x, u, k, i * STEP + k * rig.period, hidden)
            step = system.step(x[None], acting[None], hidden=hidden, forces=forces)
            outside.remember(x[n:], step.x[0, n:])
            x, hidden = step.x[0], step.hidden
            fine.append(x)
    t = np.arange(len(u)) * rig.period
    return Motion(t, np.array(states), np.array(shown), u)


class _Outside:
    """What the engine does not know: faults on the way of inputs and outputs, and forces at the joints."""

    def __init__(self, rig: Rig, tables: Tables, system: System) -> None:
        self.rig, self.tables, self.system = rig, tables, system
        n, nu = rig.plant.n, len(rig.plant.inputs)
        self.W, self.memory = np.zeros((s.WORKSPACE, n)), np.zeros((nu, 3))
        self.arrived, self.exact = np.zeros(nu, dtype=np.int64), np.array([*rig.plant.exact, 0.0])
        self.level = tables.coordinates.copy()
        self.level[:, s.TILT] = 0.0
        self.active = bool(np.any(tables.coordinates[:, : s.PAYLOAD] != self._idle()[:, : s.PAYLOAD])) or bool(
            np.any(tables.coordinates[:, s.COUPLING :])
        )

    def _idle(self) -> Array:
        return Tables(self.rig.plant, self.rig.parameters).coordinates

    def sensed(self, fine: list[Array]) -> Array:
        """Late, scaled, shifted; before the first step the state is taken to have been at rest in its place."""
        y = np.empty(2 * self.rig.plant.n)
        for j, row in enumerate(self.tables.outputs):
            back = row[s.LATE] / STEP
            whole = int(back)
            late, earlier = fine[max(len(fine) - 1 - whole, 0)][j], fine[max(len(fine) - 2 - whole, 0)][j]
            y[j] = row[s.SCALE] * (late + (back - whole) * (earlier - late)) + row[s.BIAS]
        return y

    def act(self, x: Array, u: Array, k: int, t: float, hidden: Array | None) -> tuple[Array, Array | None]:
        """(inputs that arrive, forces (1, 1, n) or None)."""
        A, C, W, n = self.tables.inputs, self.tables.coordinates, self.W, self.rig.plant.n
        acting = np.empty(len(self.arrived))
        for i in range(len(acting)):
            since = t - A[i, s.DELAY] + 1e-12
            while self.arrived[i] < k and (self.arrived[i] + 1) * self.rig.period <= since:
                self.arrived[i] += 1
            acting[i] = path(A, i, self.memory, u[self.arrived[i], i] if since >= 0 else 0.0, STEP)
        if not self.active:
            return acting, None
        W[s.NOW], W[s.SPEED] = x[:n], x[n:]
        force = np.zeros(n)
        for table, sign in ((self.level, 1.0), (C, -1.0)):
            bias(self.rig.plant.number, self.tables.parameters, self.exact, table, W, s.NOW)
            force += sign * W[s.BIASED]
        load = np.zeros(n)
        load[: len(acting)] = acting
        for j in range(n):
            passed = self._passed(j, load[j])
            other = x[n + int(C[j, s.PARTNER])]
            force[j] += law(C, j, x[j], x[n + j], W[s.BRISTLE, j], W[s.LUGRE_BRISTLE, j], t) + passed - load[j]
            force[j] -= C[j, s.COUPLING] * other
        for j in range(n):
            if dry(C, j):
                force[j] += self._friction(j, x, acting, force, load[j], hidden)
        return acting, force[None, None]

    def _passed(self, j: int, load: float) -> float:
        """What play and slip leave of the applied force."""
        C, W = self.tables.coordinates, self.W
        if C[j, s.PLAY] > 0:
            W[s.PLAYED, j] = min(max(W[s.PLAYED, j], load - C[j, s.PLAY]), load + C[j, s.PLAY])
            load = float(W[s.PLAYED, j])
        return float(C[j, s.SLIP] * np.tanh(load / C[j, s.SLIP])) if C[j, s.SLIP] > 0 else load

    def _friction(self, j: int, x: Array, acting: Array, force: Array, load: float, hidden: Array | None) -> float:
        """The velocity is affine in a force over one step: the one that stops the joint, within its bounds."""
        n, C = self.rig.plant.n, self.tables.coordinates
        pushed = force.copy()
        pushed[j] += 1.0
        free, moved = (
            self.system.step(x[None], acting[None], hidden=hidden, forces=f[None, None]).x[0, n + j] for f in (force, pushed)
        )
        v = x[n + j]
        return float(np.clip(-free / (moved - free), -bound(C, j, v, load, True), bound(C, j, v, load, False)))

    def remember(self, before: Array, after: Array) -> None:
        self.W[s.SPEED], self.W[s.NEXT_SPEED] = before, after
        for j in range(self.rig.plant.n):
            bristles(self.tables.coordinates, self.W, j, STEP)
