"""Physics engines as backends and models: a kit of their plugins."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_engines.backend": "EngineBackend as_backend",
        "gapcert_engines.config": "Coefficient EngineConfig",
        "gapcert_engines.contract": "ABSURD BodyInertia Engine EngineWorld Joint JointType Motor Thruster",
        "gapcert_engines.drive": "Drive",
        "gapcert_engines.equations_model": "PHYSICAL EngineModel",
        "gapcert_engines.native_model": "Group NativeModel",
        "gapcert_engines.robot.description": "RobotDescription chosen_model",
        "gapcert_engines.robot.files": "patched_file patched_sdf patched_urdf",
        "gapcert_engines.robot.links": "Link as_section",
        "gapcert_engines.robot.shapes": "file_shapes",
        "gapcert_engines.robot.xml_patch": "RobotText",
        "gapcert_engines.settings": "Options changed declared flat plain short",
        "gapcert_engines.silence": "muted",
        "gapcert_engines.wiring": "check_ranges step_period",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
