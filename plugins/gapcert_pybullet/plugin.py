"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "pybullet",
            "Bullet's articulated bodies from a URDF file, tiled for speed",
            "gapcert_pybullet.engine:PyBulletEngine",
            config="gapcert_pybullet.config:PyBulletConfig",
            requires=("pybullet",),
            extra="pybullet",
        )
    ]
