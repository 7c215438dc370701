"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "synthesizer",
            "mpc",
            "robust model predictive control: a tube that takes γ(x, u), in one quadratic program per step",
            "gapcert_mpc.synthesizer:Mpc",
            "gapcert_mpc.config:MpcConfig",
            requires=("osqp", "piqp"),
            extra="mpc",
            controller="gapcert_mpc.synthesizer:Mpc",
        )
    ]
