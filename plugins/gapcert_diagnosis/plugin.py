"""Declares what this package offers; imports nothing but gapcert."""

from pathlib import Path

from gapcert.plugin import EXECUTED, RUN, Argument, Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    """The sections `diagnose:` and `play:`, their commands, how engines are diagnosed, and what every effect keeps."""
    return [
        Component(
            "study",
            "diagnose",
            "causes of what a recording shows",
            "gapcert_diagnosis.study:DiagnosisStudy",
            "gapcert_diagnosis.section:DiagnoseSection",
        ),
        Component("section", "play", "what is played to a reality", "gapcert_diagnosis.section:PlaySection"),
        Component("contract", "EffectContract", "what every effect keeps", "gapcert_diagnosis.testing:EffectContract"),
        Component("diagnoser", "native", "numbers of an engine in contact", "gapcert_diagnosis.native.driver:NativeDiagnoser"),
        Component(
            "command",
            "diagnose",
            "execute a spec that has a diagnosis: why is the model wrong?",
            "gapcert.cli.commands:execute",
            arguments=EXECUTED,
        ),
        Component(
            "command",
            "extend",
            "write the extended model of a diagnosis as a spec",
            "gapcert_diagnosis.artifacts:command",
            arguments=(RUN, Argument("-o", "where to (standard output)", {"dest": "output", "type": Path, "metavar": "FILE"})),
        ),
    ]
