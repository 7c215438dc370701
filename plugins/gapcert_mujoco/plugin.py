"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "mujoco",
            "MuJoCo from an MJCF or URDF file, rolled out in C and tiled for speed",
            "gapcert_mujoco.engine:MuJoCoEngine",
            config="gapcert_mujoco.config:MuJoCoConfig",
            requires=("mujoco",),
            extra="mujoco",
        )
    ]
