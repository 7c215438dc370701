"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "executor",
            "dask",
            "a Dask cluster: one of this machine, or dask:ADDRESS of a scheduler",
            "gapcert_dask.executor:dask",
            requires=("distributed",),
            extra="dask",
        )
    ]
