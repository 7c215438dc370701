"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    """Models that are text, code, or the bodies of a robot file."""
    return [
        gapcert.Component(
            "model",
            "equations",
            "equations of motion as text: derivative, mechanical form, or the map itself",
            "gapcert_equations.model:EquationsModel",
            config="gapcert_equations.config:EquationsConfig",
            requires=("sympy", "pint"),
        ),
        gapcert.Component(
            "model",
            "python",
            "a Python function x_next = f(x, u, **parameters); needs --allow-code",
            "gapcert_equations.python_model:PythonModel",
            config="gapcert_equations.config:PythonConfig",
            requires=("pint",),
            code=True,
        ),
        gapcert.Component(
            "model",
            "engine",
            "a robot in a physics engine, by the equations of its bodies, confirmed by the engine's own steps",
            "gapcert_engines.equations_model:EngineModel",
            "gapcert_engines.model_config:EngineModelConfig",
            of=("backend",),
        ),
    ]
