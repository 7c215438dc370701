"""Options of a plugin that are called as others call theirs, and are something else: the core asks methods, never names."""

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from gapcert import Component, load_spec
from gapcert.contracts.plugins.registry import Registry

WORDS: dict[str, Any] = {
    "kind": "foreign",
    "cells": {"salad": 1},
    "inputs": {"door": "open"},
    "input_range": {"street": [2, 1]},
    "on": ["Monday"],
    "policy": "honesty",
    "gamma": {"ray": -1},
    "columns": {"Doric": "old"},
    "files": ["no such file"],
    "every": "now and then",
    "period": None,
    "of": "course",
    "sensor_noise": {"nobody": "a lot"},
    "check": True,
    "axes": "of evil",
    "settings": 3,
    "keyed": True,
    "paths": "of glory",
    "channels": 7,
    "untimed": True,
    "resampled": "songs",
    "headline": "MAN BITES DOG",
}


class Foreign(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["foreign"]
    cells: dict[str, int]
    inputs: dict[str, str] = {}
    input_range: dict[str, tuple[float, float]]
    on: list[str]
    policy: str
    gamma: dict[str, float]
    columns: dict[str, str]
    files: list[str]
    every: str
    period: str | None
    of: str
    sensor_noise: dict[str, str]
    check: bool
    axes: str
    settings: int
    keyed: bool
    paths: str
    channels: int
    untimed: bool
    resampled: str
    headline: str


def test_what_an_option_is_called_tells_the_core_nothing(folder, toys):
    kinds = ("backend", "gap_family", "synthesizer", "reader")
    foreign = [Component(k, "foreign", "?", "nowhere:Nothing", f"{__name__}:Foreign") for k in kinds]
    known = Registry([*toys.components.values(), *foreign], [], toys.manager)
    data = dict(load_spec("pendulum.yaml", components=toys).data)
    backend, goal = {k: v for k, v in WORDS.items() if k != "inputs"}, data["controller"]["goal"]
    data |= {"gap": WORDS, "backend": backend, "controller": {**WORDS, "goal": goal}}
    spec = load_spec(data, components=known)
    assert spec.config.controller.cells == spec.config.gap.cells == {"salad": 1}
    assert spec.files == ()
    drive = dict(load_spec("drive.yaml", components=toys).data)
    measured = {k: v for k, v in drive.items() if k not in ("diagnose", "expect")} | {"recording": WORDS}
    measured |= {"domain": {"q": [0, 1], "F": [0, 1]}, "certificate": {"claim": "statistical"}}
    assert load_spec(measured, components=known, folder=Path()).config.recording.columns == {"Doric": "old"}
