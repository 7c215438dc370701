"""Compiles the FMUs of this folder: `python specs/models/fmu/build.py [FOLDER]` writes MODEL.fmu (FMI 3.0), by default here.

It needs a C compiler and fmpy, which brings the FMI headers.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

HERE = Path(__file__).parent
STATE, INPUT, PARAMETER, OUTPUT, DISCRETE = "state", "input", "parameter", "output", "discrete"
UNITS = {
    "rad": "rad='1'", "rad/s": "rad='1' s='-1'", "N.m": "kg='1' m='2' s='-2'", "kg": "kg='1'", "m": "m='1'",
    "m/s2": "m='1' s='-2'", "N.m.s/rad": "kg='1' m='2' s='-1' rad='-1'", "J": "kg='1' m='2' s='-2'", "K": "K='1'",
    "m3/s": "m='3' s='-1'", "m2": "m='2'",
    "W": "kg='1' m='2' s='-3'", "W/K": "kg='1' m='2' s='-3' K='-1'", "J/K": "kg='1' m='2' s='-2' K='-1'", "1": "",
}  # fmt: skip
"""What the model descriptions call units, Modelica's way, and what they are."""
MODELS: dict[str, list[tuple[str, str, float, str]]] = {
    "pendulum": [
        ("theta", STATE, 0.1, "rad"),
        ("omega", STATE, 0.0, "rad/s"),
        ("torque", INPUT, 0.0, "N.m"),
        ("m", PARAMETER, 1.0, "kg"),
        ("l", PARAMETER, 1.0, "m"),
        ("g", PARAMETER, 9.81, "m/s2"),
        ("d", PARAMETER, 0.05, "N.m.s/rad"),
        ("energy", OUTPUT, 0.0, "J"),
    ],
    "tank": [
        ("level", STATE, 0.5, "m"),
        ("temperature", STATE, 320.0, "K"),
        ("inflow", INPUT, 1e-3, "m3/s"),
        ("heat", INPUT, 0.0, "W"),
        ("area", PARAMETER, 0.2, "m2"),
        ("hole", PARAMETER, 3e-4, "m2"),
        ("supply", PARAMETER, 290.0, "K"),
        ("ambient", PARAMETER, 293.0, "K"),
        ("loss", PARAMETER, 40.0, "W/K"),
        ("outflow", OUTPUT, 0.0, "m3/s"),
    ],
    "thermostat": [
        ("temperature", STATE, 293.0, "K"),
        ("sun", INPUT, 0.0, "W"),
        ("on", DISCRETE, 1.0, "1"),
        ("power", PARAMETER, 2000.0, "W"),
        ("loss", PARAMETER, 50.0, "W/K"),
        ("capacity", PARAMETER, 2e5, "J/K"),
        ("ambient", PARAMETER, 273.0, "K"),
        ("low", PARAMETER, 292.0, "K"),
        ("high", PARAMETER, 294.0, "K"),
    ],
}
"""Per model: name, what it is, start value, unit; the continuous states first."""


def rows(model: str) -> list[tuple[str, str, float, str]]:
    """All variables in the order of their value references: states, their derivatives, the rest."""
    states = [r for r in MODELS[model] if r[1] == STATE]
    return [*states, *((f"der_{n}", "derivative", 0.0, "") for n, *_ in states), *(r for r in MODELS[model] if r[1] != STATE)]


def description(model: str, fmi: int, snapshots: bool = True) -> str:
    """The modelDescription.xml."""
    table = rows(model)
    count = sum(r[1] == STATE for r in table)
    sections: dict[str, tuple[str, str, str]] = {
        STATE: ("output", "continuous", "exact"),
        "derivative": ("local", "continuous", ""),
        INPUT: ("input", "continuous", ""),
        PARAMETER: ("parameter", "fixed", ""),
        OUTPUT: ("output", "continuous", ""),
        DISCRETE: ("local", "discrete", "exact"),
    }
    lines, base = [], 1 if fmi == 2 else 0
    for k, (name, what, start, unit) in enumerate(table):
        causality, variability, initial = sections[what]
        derived = f" derivative='{k - count + base}'" if what == "derivative" else ""
        text = f" start='{start!r}'" if what in (STATE, INPUT, PARAMETER, DISCRETE) else ""
        units = f" unit={quoteattr(unit)}" if unit else ""
        least = " min='0'" if what == PARAMETER else ""
        head = f"name='{name}' valueReference='{k}' causality='{causality}' variability='{variability}'"
        head += f" initial='{initial}'" if initial else ""
        if fmi == 2:
            lines.append(f"<ScalarVariable {head}><Real{units}{least}{text}{derived}/></ScalarVariable>")
        else:
            lines.append(f"<Float64 {head}{units}{least}{text}{derived}/>")
    outputs = [k for k, r in enumerate(table) if r[1] in (STATE, OUTPUT)]
    able = f"canGetAndSetFMUstate='{str(snapshots).lower()}'".replace("FMUstate", "FMUstate" if fmi == 2 else "FMUState")
    units = "".join(f"<Unit name={quoteattr(u)}><BaseUnit {b}/></Unit>" for u, b in UNITS.items())
    both = f"<ModelExchange modelIdentifier='{model}' {able}/><CoSimulation modelIdentifier='{model}' {able} "
    both += "canHandleVariableCommunicationStepSize='true'/>"
    number = 1 if model == "thermostat" else 0
    if fmi == 2:
        listed = "".join(f"<Unknown index='{k + 1}'/>" for k in outputs)
        derived = "".join(f"<Unknown index='{k + 1}'/>" for k in range(count, 2 * count))
        unknown = [*outputs, *range(count, 2 * count)]
        first = "".join(f"<Unknown index='{k + 1}'/>" for k in sorted(unknown) if table[k][1] in ("derivative", OUTPUT))
        structure = f"<Outputs>{listed}</Outputs><Derivatives>{derived}</Derivatives><InitialUnknowns>{first}</InitialUnknowns>"
        root = f"fmiVersion='2.0' modelName='{model}' guid='{model}' numberOfEventIndicators='{number}'"
    else:
        structure = "".join(f"<Output valueReference='{k}'/>" for k in outputs)
        structure += "".join(f"<ContinuousStateDerivative valueReference='{k}'/>" for k in range(count, 2 * count))
        structure += "".join(f"<InitialUnknown valueReference='{k}'/>" for k in range(count, 2 * count))
        structure += "".join(f"<InitialUnknown valueReference='{k}'/>" for k, r in enumerate(table) if r[1] == OUTPUT)
        structure += "<EventIndicator valueReference='0'/>" * number
        root = f"fmiVersion='3.0' modelName='{model}' instantiationToken='{model}'"
        lines.append(f"<Float64 name='time' valueReference='{len(table)}' causality='independent' variability='continuous'/>")
    return (
        f"<?xml version='1.0' encoding='UTF-8'?>\n<fmiModelDescription {root}>{both}<UnitDefinitions>{units}</UnitDefinitions>"
        f"<DefaultExperiment startTime='0' stopTime='1'/><ModelVariables>{''.join(lines)}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>\n"
    )


def header(model: str) -> str:
    """table.h: the model's variables in C."""
    table = rows(model)
    kinds = {INPUT: "INPUT", PARAMETER: "PARAMETER", STATE: "STATE", DISCRETE: "STATE"}
    count = sum(r[1] == STATE for r in table)
    return "\n".join(
        [
            f"enum {{ {', '.join(r[0] for r in table)}, NV }};",
            f"enum {{ NX = {count}, NZ = {1 if model == 'thermostat' else 0} }};",
            f"static const int KIND[NV] = {{ {', '.join(kinds.get(r[1], 'OUTPUT') for r in table)} }};",
            f"static const double START[NV] = {{ {', '.join(repr(r[2]) for r in table)} }};",
            f'#define TOKEN "{model}"',
            "",
        ]
    )


def build(model: str, path: Path, fmi: int = 3, flags: Sequence[str] = (), compiler: str = "cc") -> Path:
    """One FMU at `path`; flags: further ones for the compiler, such as -DNO_SNAPSHOTS."""
    import fmpy

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "table.h").write_text(header(model))
        library = Path(folder) / f"{model}.so"
        include = [f"-I{folder}", f"-I{HERE}", f"-I{Path(fmpy.__file__).parent / 'c-code'}"]
        options = ["-O2", "-ffp-contract=off", "-shared", "-fPIC", f'-DMODEL="{model}.c"', *flags, *include]
        subprocess.run([compiler, *options, str(HERE / f"fmi{fmi}.c"), "-lm", "-o", str(library)], check=True)
        machine = "linux64" if fmi == 2 else f"{platform.machine()}-linux"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description(model, fmi, "-DNO_SNAPSHOTS" not in flags))
            archive.write(library, f"binaries/{machine}/{model}.so")
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=HERE)
    folder = parser.parse_args().folder
    for name in MODELS:
        sys.stdout.write(f"{build(name, folder / f'{name}.fmu')}\n")
