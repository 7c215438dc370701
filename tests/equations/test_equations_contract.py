"""Equation models and Python models keep the contract of every System."""

from pathlib import Path

import gapcert as gc
from gapcert.testing import SystemContract
from gapcert_equations.config import EquationsConfig, PythonConfig


class TestDerivative(SystemContract):
    def system(self) -> gc.System:
        from gapcert_equations.model import EquationsModel

        spec = {
            "kind": "equations",
            "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
            "inputs": {"torque": "N*m"},
            "parameters": {"J": "1 kg*m^2", "w": "3 N*m", "late": {"value": "8 ms", "low": "0 s", "high": "20 ms"}},
            "derivative": {"theta": "omega", "omega": "(torque - w*sin(theta))/J"},
            "input_delay": {"torque": "late"},
            "integrator": "rk4",
            "substeps": 2,
            "period": "5 ms",
        }
        return EquationsModel(EquationsConfig.model_validate(spec))


class TestMechanical(SystemContract):
    def system(self) -> gc.System:
        from gapcert_equations.model import EquationsModel

        spec = {
            "kind": "equations",
            "coordinates": {"a": "rad", "b": "rad"},
            "inputs": {"u": "N*m"},
            "parameters": {"J": "0.4 kg*m^2", "k": "0.1 kg*m^2", "f": "0.5 N*m"},
            "mass_matrix": [["J", "k*cos(a - b)"], ["k*cos(a - b)", "J/2"]],
            "forces": {"a": "u"},
            "dry_friction": {"a": "f", "b": "f/3"},
            "integrator": "semi_implicit",
            "period": "10 ms",
        }
        return EquationsModel(EquationsConfig.model_validate(spec))


class TestPython(SystemContract):
    def system(self) -> gc.System:
        from gapcert_equations.python_model import PythonModel

        folder = Path(__file__).parents[1] / "data"
        spec = {
            "kind": "python",
            "function": "oscillator:step",
            "states": {"q": "m", "v": "m/s"},
            "inputs": {"u": "m/s^2"},
            "parameters": {"k": "2 1/s^2"},
            "period": "100 ms",
        }
        return PythonModel.from_config(PythonConfig.model_validate(spec), gc.Context(folder=folder, allow_code=True))
