"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "gymnasium",
            "a Gymnasium environment as a function of its state: classic control, MuJoCo, and registered ones",
            "gapcert_gymnasium.system:GymnasiumBackend",
            config="gapcert_gymnasium.config:GymnasiumConfig",
            requires=("gymnasium",),
            extra="gymnasium",
        )
    ]
