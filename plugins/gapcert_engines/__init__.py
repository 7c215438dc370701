"""Physics engines as backends and models: a kit of their plugins."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Drive": "gapcert_engines.drive",
    "Engine": "gapcert_engines.contract",
    "EngineBackend": "gapcert_engines.backend",
    "EngineConfig": "gapcert_engines.config",
    "EngineModel": "gapcert_engines.equations_model",
    "EngineWorld": "gapcert_engines.contract",
    "Group": "gapcert_engines.native_model",
    "Joint": "gapcert_engines.contract",
    "Link": "gapcert_engines.robot.links",
    "Motor": "gapcert_engines.contract",
    "NativeModel": "gapcert_engines.native_model",
    "PHYSICAL": "gapcert_engines.variants",
    "RobotText": "gapcert_engines.robot.xml_patch",
    "Thruster": "gapcert_engines.contract",
    "as_section": "gapcert_engines.robot.links",
    "file_shapes": "gapcert_engines.robot.shapes",
    "muted": "gapcert_engines.silence",
    "patched_sdf": "gapcert_engines.robot.files",
    "patched_urdf": "gapcert_engines.robot.files",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
