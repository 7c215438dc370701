"""γ that a person declares, where no backend is there to be asked: an assumption, saved and shown as one."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from gapcert.certification.certificate import Band, SavedStatement
from gapcert.certification.routes import declaration, scope
from gapcert.contracts.gaps.claim import Claim
from gapcert.contracts.gaps.gap import GapFunction
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model
from gapcert.version import __version__


@final
@dataclass(frozen=True, repr=False)
class Declaration(SavedStatement):
    """|f̂ − f| ≤ γ on Z as a person says it, of a backend that nobody asked. The claim is `assumed`, and never more."""

    gap: GapFunction
    model: Model
    domain: Domain
    versions: Mapping[str, str] = field(default_factory=lambda: {"gapcert": __version__, "python": platform.python_version()})
    claim = Claim("assumed")
    reason = "γ is declared and assumed; no simulator was asked"

    @property
    def assumptions(self) -> tuple[str, ...]:
        names = [s.name for s in self.model.states]
        nobody = "No simulator was asked: nothing speaks for γ, and nothing was given the chance to refute it."
        return (declaration(self.gap, names, self.domain), nobody, scope(self.model, self.domain))

    def _about(self) -> tuple[Domain, Band]:
        return self.domain, self.gap.interval

    def summary(self) -> dict[str, Any]:
        """The `certificate` object of the JSON contract: without samples or an audit."""
        top = self.gap.gamma_over(self.domain.interval)[0].tolist()
        return {
            "claim": self.claim.summary(),
            "family": self.gap.family,
            "route": "declared",
            "states": {s.name: {"gamma_max": g} for s, g in zip(self.model.states, top, strict=True)},
            "assumptions": list(self.assumptions),
            "vacuous": False,
        }

    def save(self, folder: Path | str) -> None:
        """`certificate.json` and `certificate.npz`."""
        self._write(Path(folder), "none", {})
