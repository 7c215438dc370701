"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "fmu",
            "a Functional Mock-up Unit (FMI 2.0 and 3.0); its binary is native code, so it needs --allow-code",
            "gapcert_fmu.system:FmuBackend",
            config="gapcert_fmu.config:FmuConfig",
            requires=("fmpy",),
            extra="fmu",
            code=True,
        )
    ]
