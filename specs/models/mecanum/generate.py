"""One four-wheel mecanum base, written for every engine: `python specs/models/mecanum/generate.py` renews the files here.

rollers.xml, rollers.urdf: each wheel carries free rollers (spheres on axes at 45°). barrels.xml, barrels.urdf: the same with
barrel-shaped rollers, which make the rim round, and a front axle that rocks, so that all four wheels carry. spheres.sdf: as in
Gazebo, sphere wheels whose friction acts along one direction only. surface.xml: no wheels at all, but four patches of ground
contact whose surface moves at the wheel's rim speed and grips along the rollers' axes only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Wheel:
    """Where it is (m), and the sign of its rollers' axes: at the ground they point along (1, sign) / √2."""

    name: str
    x: float
    y: float
    sign: int


@dataclass(frozen=True)
class Mecanum:
    """Metres, kilograms. The base's frame is in the middle between the axles, one wheel radius above the ground; its centre of
    mass lies `drop` below. Each roller is a string of `beads` spheres that touch the wheel's rim from within. A front axle of
    mass `beam` (taken from the body's; 0: there is none) turns about a line along the ground, where friction has no lever on
    it. MuJoCo's contacts are soft as rubber is (40 ms), so that the base at rest sinks by `sink`, on rollers by `roller_sink`.
    """

    radius: float = 0.05
    half_length: float = 0.3
    half_width: float = 0.25
    body: float = 4.0
    hub: float = 0.3
    rollers: int = 12
    roller: float = 0.02
    roller_radius: float = 0.01
    beads: int = 1
    beam: float = 0.0
    friction: float = 1.0
    drop: float = 0.03
    sink: float = 2.07e-4
    lag: float = 0.2
    roller_sink: float = 6.025e-4

    @property
    def wheels(self) -> tuple[Wheel, ...]:
        x, y = self.half_length, self.half_width
        return (
            Wheel("front_left", x, y, -1),
            Wheel("front_right", x, -y, 1),
            Wheel("rear_left", -x, y, 1),
            Wheel("rear_right", -x, -y, -1),
        )

    @property
    def wheel_mass(self) -> float:
        return self.hub + self.rollers * self.roller

    @property
    def mass(self) -> float:
        return self.body + 4 * self.wheel_mass

    def body_inertia(self) -> tuple[float, float, float]:
        """Of a box as long and wide as the wheel base, 6 cm high."""
        a, b, c, share = 2 * self.half_length, 2 * self.half_width, 0.06, (self.body - self.beam) / 12
        return share * (b * b + c * c), share * (a * a + c * c), share * (a * a + b * b)

    def whole_inertia(self) -> tuple[float, float, float]:
        """Of the body with its wheels, taken as points at the axles' ends."""
        x, y, m = self.half_length, self.half_width, 4 * self.wheel_mass
        ixx, iyy, izz = self.body_inertia()
        return ixx + m * y * y, iyy + m * x * x, izz + m * (x * x + y * y)

    def hub_inertia(self) -> tuple[float, float, float]:
        """Of a cylinder 4 cm wide, within the rollers."""
        r = self.radius - 2 * self.roller_radius
        across = self.hub * (3 * r * r + 0.04**2) / 12
        return across, self.hub * r * r / 2, across

    def roller_inertia(self) -> float:
        return 0.4 * self.roller * self.roller_radius**2

    def beam_inertia(self) -> tuple[float, float, float]:
        """Of a bar as long as the axle is wide, 4 cm thick."""
        across, along = self.beam * (4 * self.half_width**2 + 0.04**2) / 12, self.beam * 0.04**2 / 6
        return across, along, across

    def strung(self) -> Iterator[tuple[float, float]]:
        """Place along a roller's axis and radius of each of its spheres, which stand for equal angles of the rim."""
        reach = self.radius - self.roller_radius
        for k in range(self.beads):
            angle = 2 * math.pi / (self.rollers * self.beads) * (k - (self.beads - 1) / 2)
            yield reach * math.tan(angle) / _HALF, self.radius - reach / math.cos(angle)

    def placed(self, wheel: Wheel) -> Iterator[tuple[str, tuple[float, float, float], tuple[float, float, float]]]:
        """Name, position in the wheel's frame and axis of each roller; the first is at the ground."""
        reach = self.radius - self.roller_radius
        for k in range(self.rollers):
            phi = 2 * math.pi * k / self.rollers
            at = (reach * math.sin(phi), 0.0, -reach * math.cos(phi))
            yield f"{wheel.name}_{k}", at, (math.cos(phi) * _HALF, wheel.sign * _HALF, math.sin(phi) * _HALF)


_HALF = math.sqrt(0.5)


def _n(*values: float) -> str:
    return " ".join(f"{v:.9g}" for v in (0.0 if abs(v) < 1e-12 else v for v in values))


def mjcf(m: Mecanum) -> str:
    """Free rollers for MuJoCo; the ground is the spec's."""
    out = [
        '<mujoco model="mecanum">',
        '  <compiler angle="radian"/>',
        '  <option timestep="0.001" cone="elliptic"/>',
        "  <default>",
        '    <default class="body"><geom contype="0" conaffinity="0"/></default>',
        '    <default class="roller">',
        f'      <geom type="sphere" size="{_n(m.roller_radius)}" friction="{_n(m.friction)} 0 0"/>',
        "    </default>",
        "  </default>",
        "  <worldbody>",
        f'    <body name="base" pos="0 0 {_n(m.radius - m.roller_sink)}">',
        '      <freejoint name="base"/>',
        f'      <inertial pos="{_n(0, 0, -m.drop)}" mass="{_n(m.body - m.beam)}" diaginertia="{_n(*m.body_inertia())}"/>',
        f'      <geom class="body" type="box" size="{_n(m.half_length, m.half_width, 0.03)}"/>',
    ]
    if m.beam:
        out += [
            f'      <body name="front" pos="{_n(m.half_length, 0, -m.radius)}">',
            '        <joint name="front" type="hinge" axis="1 0 0"/>',
            f'        <inertial pos="{_n(0, 0, m.radius)}" mass="{_n(m.beam)}" diaginertia="{_n(*m.beam_inertia())}"/>',
            *(f"  {line}" for w in m.wheels if w.x > 0 for line in _mjcf_wheel(m, w, (0, w.y, m.radius))),
            "      </body>",
        ]
    for w in m.wheels:
        if w.x < 0 or not m.beam:
            out += _mjcf_wheel(m, w, (w.x, w.y, 0))
    return "\n".join([*out, "    </body>", "  </worldbody>", "</mujoco>"]) + "\n"


def _mjcf_wheel(m: Mecanum, w: Wheel, place: tuple[float, float, float]) -> list[str]:
    out = [
        f'      <body name="{w.name}" pos="{_n(*place)}">',
        f'        <joint name="{w.name}" type="hinge" axis="0 1 0"/>',
        f'        <inertial pos="0 0 0" mass="{_n(m.hub)}" diaginertia="{_n(*m.hub_inertia())}"/>',
    ]
    for name, at, axis in m.placed(w):
        i = m.roller_inertia()
        out += [
            f'        <body name="{name}" pos="{_n(*at)}">',
            f'          <joint name="{name}" type="hinge" axis="{_n(*axis)}"/>',
            f'          <inertial pos="0 0 0" mass="{_n(m.roller)}" diaginertia="{_n(i, i, i)}"/>',
        ]
        for along, radius in m.strung():
            bead = f' pos="{_n(*(along * a for a in axis))}" size="{_n(radius)}"' if m.beads > 1 else ""
            out.append(f'          <geom class="roller"{bead} contype="0" conaffinity="1"/>')
        out.append("        </body>")
    return [*out, "      </body>"]


def urdf(m: Mecanum) -> str:
    """Free rollers for PyBullet and DART; the ground is the spec's, and the base's frame lies on it, for want of a pose."""
    body = _link("base", m.body - m.beam, m.body_inertia(), height=m.radius - m.drop)
    out = ['<?xml version="1.0"?>', '<robot name="mecanum">', *body]
    if m.beam:
        out += _link("front", m.beam, m.beam_inertia(), height=m.radius)
        out += _joint("front", "base", (m.half_length, 0.0, 0.0), (1.0, 0.0, 0.0))
    for w in m.wheels:
        out += _link(w.name, m.hub, m.hub_inertia())
        rocks = m.beam > 0 and w.x > 0
        place = (0.0 if rocks else w.x, w.y, m.radius)
        out += _joint(w.name, "front" if rocks else "base", place, (0.0, 1.0, 0.0))
        for name, at, axis in m.placed(w):
            beads = [(tuple(along * a for a in axis), radius) for along, radius in m.strung()]
            out += _link(name, m.roller, (m.roller_inertia(),) * 3, beads)
            out += _joint(name, w.name, at, axis)
    return "\n".join([*out, "</robot>"]) + "\n"


def _link(
    name: str,
    mass: float,
    inertia: tuple[float, float, float],
    spheres: Sequence[tuple[tuple[float, ...], float]] = (),
    height: float = 0.0,
) -> list[str]:
    ixx, iyy, izz = (_n(i) for i in inertia)
    at = f'<origin xyz="{_n(0, 0, height)}"/>' if height else ""
    shapes = []
    for place, radius in spheres:
        where = f'<origin xyz="{_n(*place)}"/>' if any(place) else ""
        shapes.append(f'    <collision>{where}<geometry><sphere radius="{_n(radius)}"/></geometry></collision>')
    return [
        f'  <link name="{name}">',
        f'    <inertial>{at}<mass value="{_n(mass)}"/>',
        f'      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>',
        *shapes,
        "  </link>",
    ]


def _joint(name: str, parent: str, at: tuple[float, float, float], axis: tuple[float, float, float]) -> list[str]:
    return [
        f'  <joint name="{name}_axle" type="continuous">',
        f'    <parent link="{parent}"/><child link="{name}"/><origin xyz="{_n(*at)}"/><axis xyz="{_n(*axis)}"/>',
        "  </joint>",
    ]


def sdf(m: Mecanum) -> str:
    """Gazebo's way: sphere wheels that grip along the rollers' axis (mu) and not across it (mu2 = 0)."""
    out = [
        '<?xml version="1.0"?>',
        '<sdf version="1.9" xmlns:ignition="http://ignitionrobotics.org/schema">',
        '  <world name="room">',
        "    <gravity>0 0 -9.81</gravity>",
        '    <model name="ground">',
        "      <static>true</static>",
        '      <link name="ground">',
        '        <collision name="plane">',
        "          <geometry><plane><normal>0 0 1</normal><size>100 100</size></plane></geometry>",
        f"          <surface><friction><ode><mu>{_n(m.friction)}</mu><mu2>{_n(m.friction)}</mu2></ode></friction></surface>",
        "        </collision>",
        "      </link>",
        "    </model>",
        '    <model name="mecanum">',
        f"      <pose>0 0 {_n(m.radius)} 0 0 0</pose>",
        '      <link name="base">',
        *_sdf_inertial(m.body, m.body_inertia(), m.drop),
        "      </link>",
    ]
    for w in m.wheels:
        hub, rim = m.hub_inertia(), 0.6 * m.rollers * m.roller * m.radius**2
        out += [
            f'      <link name="{w.name}">',
            f'        <pose relative_to="base">{_n(w.x, w.y, 0)} 0 0 0</pose>',
            *_sdf_inertial(m.wheel_mass, (hub[0] + rim, hub[1] + rim, hub[2] + rim)),
            '        <collision name="sphere">',
            f"          <geometry><sphere><radius>{_n(m.radius)}</radius></sphere></geometry>",
            f"          <surface><friction><ode><mu>{_n(m.friction)}</mu><mu2>0</mu2>",
            f'            <fdir1 ignition:expressed_in="base">1 {w.sign} 0</fdir1></ode></friction></surface>',
            "        </collision>",
            "      </link>",
            f'      <joint name="{w.name}_axle" type="revolute">',
            f"        <parent>base</parent><child>{w.name}</child>",
            "        <axis><xyz>0 1 0</xyz></axis>",
            "      </joint>",
        ]
    return "\n".join([*out, "    </model>", "  </world>", "</sdf>"]) + "\n"


def _sdf_inertial(mass: float, inertia: tuple[float, float, float], drop: float = 0.0) -> list[str]:
    ixx, iyy, izz = (_n(i) for i in inertia)
    at = f"<pose>{_n(0, 0, -drop)} 0 0 0</pose>" if drop else ""
    return [
        f"        <inertial>{at}<mass>{_n(mass)}</mass>",
        f"          <inertia><ixx>{ixx}</ixx><iyy>{iyy}</iyy><izz>{izz}</izz></inertia></inertial>",
    ]


def surface(m: Mecanum) -> str:
    """Six degrees of freedom for MuJoCo: capsules along the rollers' axes, gripping along them, with a moving surface."""
    out = [
        '<mujoco model="mecanum surface">',
        '  <compiler angle="radian"/>',
        '  <option timestep="0.001" cone="elliptic"/>',
        "  <worldbody>",
        '    <geom name="ground" type="plane" size="0 0 1" contype="0" conaffinity="0"/>',
        f'    <body name="base" pos="0 0 {_n(m.radius - m.sink)}">',
        '      <freejoint name="base"/>',
        f'      <inertial pos="{_n(0, 0, -m.drop)}" mass="{_n(m.mass)}" diaginertia="{_n(*m.whole_inertia())}"/>',
    ]
    for w in m.wheels:
        ends = _n(w.x - 0.005 * _HALF, w.y - w.sign * 0.005 * _HALF, 0, w.x + 0.005 * _HALF, w.y + w.sign * 0.005 * _HALF, 0)
        out.append(
            f'      <geom name="{w.name}" type="capsule" size="{_n(m.radius)}" fromto="{ends}" contype="0" conaffinity="0"'
            ' surfacevel="0 0 1 0 0 0"/>'
        )
    out += ["    </body>", "  </worldbody>", "  <contact>"]
    for w in m.wheels:
        out.append(
            f'    <pair geom1="ground" geom2="{w.name}" condim="3" friction="{_n(m.friction, 1e-5)} 0 0 0" solref="0.04 1"'
            f' solreffriction="{_n(m.lag)} 1"/>'
        )
    return "\n".join([*out, "  </contact>", "</mujoco>"]) + "\n"


BARRELS = Mecanum(beads=3, beam=0.4)
FILES = {"rollers.xml": mjcf, "rollers.urdf": urdf, "spheres.sdf": sdf, "surface.xml": surface}
FILES |= {"barrels.xml": lambda m: mjcf(BARRELS), "barrels.urdf": lambda m: urdf(BARRELS)}

if __name__ == "__main__":
    for name, write in FILES.items():
        (Path(__file__).parent / name).write_text(write(Mecanum()), encoding="utf-8")
