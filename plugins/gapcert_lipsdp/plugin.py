"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "lipschitz",
            "lipsdp",
            "proved constants of neural networks at the optimum of LipSDP (from Python; residuals have others)",
            "gapcert_lipsdp.lipsdp:LipSDP",
            "gapcert_lipsdp.config:LipSDPConfig",
        )
    ]
