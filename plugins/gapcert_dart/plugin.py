"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "dart",
            "DART's articulated bodies from a URDF or SDF file, tiled for speed",
            "gapcert_dart.engine:DartEngine",
            config="gapcert_dart.config:DartConfig",
            requires=("dartpy",),
            extra="dart",
        )
    ]
