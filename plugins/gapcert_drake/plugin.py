"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "drake",
            "Drake's multibody plant from a URDF, SDF or MJCF file, discrete or continuous, tiled for speed",
            "gapcert_drake.engine:DrakeEngine",
            config="gapcert_drake.config:DrakeConfig",
            requires=("pydrake",),
            extra="drake",
        )
    ]
