"""A checked spec, as the rest of the program has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

from gapcert.spec.sections import sections as s
from gapcert.spec.sections.areas import GoalConfig
from gapcert.spec.sections.hidden import HiddenConfig


@final
@dataclass(frozen=True)
class Config:
    """A checked spec. Sections with a `kind` hold their plugin's config model; boxes are in the model's units, as floats.

    `sections` are those that plugins contribute, by name; `study` is the one that answers in place of a certificate, if any.
    """

    name: str
    seed: int = 0
    model: Any = None
    backend: Any = None
    domain: Mapping[str, tuple[float, float]] | None = None
    relations: tuple[str, ...] = ()
    coordinates: Mapping[str, str] = field(default_factory=dict)
    symmetries: s.SymmetriesConfig | None = None
    hidden: HiddenConfig | None = None
    sampling: s.GridSampling | s.AdaptiveSampling | s.LatticeSampling | None = None
    lipschitz: Mapping[str, Any] = field(default_factory=dict)
    gap: Any = None
    certificate: s.CertificateConfig | None = None
    controller: Any = None
    goal: GoalConfig | None = None
    recording: Any = None
    reality: Any = None
    sections: Mapping[str, Any] = field(default_factory=dict)
    study: str = ""
    report: s.ReportConfig = field(default_factory=s.ReportConfig)
    expect: Mapping[str, Any] = field(default_factory=dict)
