"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "gap_family",
            "neural",
            "networks for both sides of the band, trained on the integral of the certified band",
            "gapcert_neural.family:Neural",
            "gapcert_neural.config:NeuralConfig",
            requires=("torch",),
            extra="neural",
        )
    ]
