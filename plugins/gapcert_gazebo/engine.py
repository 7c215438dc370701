"""Engine `gazebo`: a robot of an SDF world in Gazebo's own physics, ign-physics with DART behind it."""

from __future__ import annotations

import functools
import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import final

from gapcert import Array, Context, Parameter, UsageError
from gapcert.plugin import Scene
from gapcert_engines import BodyInertia, Drive, Engine, EngineBackend, Link, file_shapes, patched_file

from .config import GazeboConfig
from .sdf import Description, world_text
from .shim import shim
from .system import versions
from .world import GazeboWorld, opened


@final
class GazeboEngine(Engine):
    """Parameters: `gravity_x`, `_y`, `_z`; `damping.JOINT`; `coulomb_friction.JOINT`, dry; `mass.LINK`, its inertia in
    proportion; and, where shapes may touch, `friction`, a factor on the friction coefficients of all of them."""

    config: GazeboConfig
    friction_after = True

    def __init__(self, config: GazeboConfig, folder: Path | None = None) -> None:
        self.config = config
        path = (folder or Path()) / config.robot
        self.file, self._text = str(path), world_text(path, config.ground)
        self._options = config.model or "", config.collision_detector or "", config.solver or ""
        d = self._found = _described(self._text, self._options, self.file)
        self.joints, self.base = tuple(d.joints), d.base
        if d.base and config.fixed_base:
            raise UsageError(f"robot: {self.file}: its base floats; set fixed_base: false, or join it to the world in the file")
        if not d.base and not config.fixed_base:
            raise UsageError(f"robot: {self.file}: its base is joined to the world; set fixed_base: true")
        self._order, self.parameters = self._native(d)
        self._versions = [d.engine, *versions()]

    @classmethod
    def from_config(cls, config: GazeboConfig, context: Context) -> EngineBackend:
        engine = cls(config, context.folder)
        backend = EngineBackend(engine, model=context.model)
        engine._check_drive()
        _nanoseconds(backend.period, config.substeps)
        return backend

    def open(self, copies: int, period: float, drive: Drive | None) -> GazeboWorld:
        config = self.config
        world = GazeboWorld(
            opened(self._text, self._options, _nanoseconds(period, config.substeps), self.file),
            self._order,
            config.substeps,
            self.file,
        )
        if drive is not None:
            movable = [j.name for j in self.joints if j.movable]
            world.follow(drive, [movable.index(name) for name in drive.elements])
        return world

    def digest_data(self) -> list[object]:
        return [*self._versions, hashlib.sha256(self._text.encode()).hexdigest()]

    def beyond(self) -> tuple[str, ...]:
        found = {"shapes that may touch": self._found.touches, "links in a loop": self._found.links({}, self.stated) is None}
        return (*super().beyond(), *(what for what, there in found.items() if there))

    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        links = self._found.links(coordinates, self.stated)
        assert links is not None, "nothing goes beyond its bodies"
        return links

    def implicit(self) -> bool:
        return True

    def accuracy(self, values: Mapping[str, float]) -> float:
        """DART's constraints, of which dry friction is one, give way by 1e-9 of their impulse, and joints share impulses."""
        return 1e-7 if self.rubs(values) else super().accuracy(values)

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        config = self.config
        given = {"damping": config.joint_damping, "coulomb_friction": config.coulomb_friction}
        text = Path(self.file).read_text(encoding="utf-8")
        patched, unsaid = patched_file(text, values, self.stated, {}, given, self._found.model)
        code = "".join(f"    {n!r}: {float(v)!r},\n" for n, v in unsaid.items())
        # Gazebo has no Python of its own to load a file with.
        told = f"# What extended.sdf cannot say: give it to step or rollout of the backend.\nparameters = {{\n{code}}}\n"
        return patched | ({"extended.py": told} if unsaid else {})

    def scene(self, position: Array, base: Array | None) -> Scene:
        world = self.open(1, self.config.substeps * 1e-3, None)
        try:
            world.set(self.stated)
            poses = world.poses(position, base, len(self._found.masses))
        finally:
            world.close()
        names = list(self._found.masses)
        model = next((m for m in ET.fromstring(self._text).iter("model") if m.get("name") == self._found.model), None)
        shapes = () if model is None else file_shapes(model, Path(self.file).parent, names)
        scene = Scene(tuple(names), shapes, poses)
        return scene if self.config.ground is None else scene.with_ground()

    def tiles(self) -> tuple[int, str]:
        return 1, "untiled: Gazebo spends its time on robots, not on worlds, so copies gain little"

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp, and where the base floats 2e-9: DART turns by truncated series, and takes other terms below 1e-4 rad."""
        return super().resolution(magnitude) + (2e-9 if self.base else 0.0)

    def _check_drive(self) -> None:
        drive = self.config.drive
        if drive is None or drive.gain is not None or drive.limit is not None:
            return
        if stiff := [name for name in self._found.stiff if name in drive.elements]:
            raise UsageError(
                f"backend.drive: joint '{stiff[0]}' has limits, which Gazebo's rate motor heeds only where its effort has one; "
                "add for instance limit: 100"
            )

    def _native(self, d: Description) -> tuple[tuple[str, ...], tuple[Parameter, ...]]:
        """The order in which the shim takes the numbers, and the parameters that they are."""
        config = self.config
        found = list(self.gravity_parameters(config.gravity or d.gravity))
        for j in d.joints:
            if j.movable:
                found.append(self.joint_parameter("damping", j, j.damping, config.joint_damping))
                found.append(self.joint_parameter("coulomb_friction", j, d.friction[j.name], config.coulomb_friction))
        found += [p for link, mass in d.masses.items() for p in BodyInertia(link, mass).parameters(lightest=None)]
        grip = Parameter("friction", 1.0, low=0.0)
        order = (*(p.name for p in found), grip.name)
        return order, (*found, grip) if d.touches else tuple(found)


@functools.lru_cache(maxsize=64)
def _described(text: str, options: tuple[str, str, str], file: str) -> Description:
    # Reading an SDF text takes Gazebo about 70 ms.
    handle = opened(text, options, 1_000_000, file)
    try:
        return Description.parse(shim().describe(handle).decode())
    finally:
        shim().close(handle)


def _nanoseconds(period: float, substeps: int) -> int:
    """One sub-step, which Gazebo counts in whole nanoseconds."""
    exact = period / substeps * 1e9
    if abs(exact - round(exact)) > 1e-3 or exact < 1:
        raise UsageError(
            f"backend.substeps: {period} s in {substeps} sub-steps are {exact:.9g} ns each; Gazebo counts whole nanoseconds, "
            "so take another number of sub-steps"
        )
    return round(exact)
