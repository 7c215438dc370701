"""Property tests draw the same examples every time, nothing reports home, and one small run serves all that look at runs."""

import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

# Two workers on two cores: a second thread of a worker only takes the core of the other. Before NumPy is imported.
os.environ |= {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")} | {"NUMBA_NUM_THREADS": "2"}

import pytest
from hypothesis import settings
from shared import once

pytest_plugins = ["tiers", "outside", "durations"]

# A loaded machine is no failure.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
os.environ["RERUN_ANALYTICS"] = "0"


# A shell that runs the tests in the background makes them deaf to Ctrl-C, and what they start as well.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """All that is collected stays: looking through it for garbage, then and later, takes a fifth of the time and finds none."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """What tests need is imported when one of them runs: collecting them imports nothing that is dear."""
    for mark in item.iter_markers("needs"):
        for module in mark.args:
            pytest.importorskip(module, reason=f"{module} is not installed")


PENDULUM = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "euler",
    "period": "20 ms",
}
SMALL = {
    "version": 1,
    "name": "small",
    "model": PENDULUM,
    "backend": PENDULUM | {"integrator": "semi_implicit"},
    "domain": {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 40, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope", "predictor": "affine"},
    "certificate": {"claim": "deterministic"},
    "controller": {
        "kind": "symbolic",
        "goal": {"invariance": {"theta": [0, 0.2], "omega": [-0.25, 0.25]}},
        "cells": {"theta": 40, "omega": 40},
        "inputs": {"torque": 21},
        "policy": "first",
    },
    "closed_loop": {"steps": 60, "starts": 10},
    "expect": {"verdict": "holds"},
}


@pytest.fixture(scope="session")
def collected(tmp_path_factory):
    """(the names of all tests, the modules imported by then) of a fresh process that collects them."""
    program = (
        "import sys, pytest; code = pytest.main(['--collect-only', '-q', '-p', 'no:cacheprovider']); "
        "print(*sys.modules); sys.exit(code)"
    )

    def collect(folder):
        done = subprocess.run([sys.executable, "-c", program], cwd=Path(__file__).parents[1], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-4000:]
        (folder / "said").write_text(done.stdout)

    *names, modules = (once(tmp_path_factory, "collected", collect) / "said").read_text().splitlines()
    return [name for name in names if "::" in name], set(modules.split())


@pytest.fixture(scope="session")
def small_spec():
    """The spec of `small_run`."""
    return SMALL


@pytest.fixture(scope="session")
def small_run(tmp_path_factory):
    """The run of SMALL: certificate, two controllers, closed loop, figures, report and recording."""
    import gapcert

    return gapcert.run(SMALL, out=tmp_path_factory.mktemp("runs"))


@pytest.fixture
def every_picture():
    """A diagnosis with a picture of every kind."""
    import numpy as np

    from gapcert_figures.diagnosis import Channel, Correlation, Course, DiagnosisFigure, Law, Signal, Waterfall

    t, rng = np.linspace(0, 1, 50), np.random.default_rng(1)
    force = "missing force [N*m]"
    laws = (
        Law("Coulomb friction at joint2", "joint2_dot [rad/s]", force, t, -t, t, -t, 0.1 + 0 * t),
        Law("backlash at joint2", "u [N*m]", force, t, t, t, t, 0.1 + 0 * t, (t > 0.5) * 1.0, "loop"),
        Law("load at joint2", "u [N*m]", force, t, t, t, t, 0.1 + 0 * t, shape="cloud", lead=False),
    )
    return DiagnosisFigure(
        (Channel("joint2", "rad", t, np.sin(t), np.cos(t), np.sin(t) + 0.01),),
        laws,
        Waterfall(("none", "Coulomb friction at joint2"), np.array([1.0, 0.25])),
        (Correlation("joint2", "itself", t, np.exp(-t), rng.normal(size=50) / 50, 0.05),),
        (Course(t, 20 + t, 1 + 0.1 * t),),
        (Signal("u", "N*m", t, np.sin(20 * t)),),
    )
