"""Compiles what most tests call, where this user has not compiled it yet: before two workers do so at the same time."""

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from conftest import SMALL

import gapcert as gc

with tempfile.TemporaryDirectory() as folder:
    gc.run(
        {**SMALL, "report": {"html": False, "rerun": False}, "closed_loop": {"steps": 2, "starts": 1}, "expect": {}}, out=folder
    )
    model = gc.load_spec(SMALL).build("model")
    model.fast_rollout(np.zeros((64, model.nx)), np.zeros((64, 4, model.nu)))
