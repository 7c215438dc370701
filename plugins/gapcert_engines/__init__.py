"""Physics engines as backends and models: a kit of their plugins."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_engines.backend": "EngineBackend as_backend",
        "gapcert_engines.config": "Coefficient EngineConfig",
        "gapcert_engines.contract": "ABSURD BodyInertia Drive Engine EngineWorld Joint JointType Law Motor "
        "Actuator ball_columns body_columns",
        "gapcert_engines.equations_model": "PHYSICAL EngineModel",
        "gapcert_engines.native_model": "Group NativeModel",
        "gapcert_engines.robot.description": "RobotDescription chosen_model read_robot",
        "gapcert_engines.robot.links": "Link as_section largest_moment moments",
        "gapcert_engines.robot.patch": "RobotText patched_file patched_sdf patched_urdf setting_code",
        "gapcert_engines.robot.shapes": "file_shapes",
        "gapcert_engines.settings": "Options changed declared flat plain short",
        "gapcert_engines.silence": "muted",
        "gapcert_engines.wiring": "UNITS check_ranges step_period",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
