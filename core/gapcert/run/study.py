"""A study: what else a spec may ask for, in place of a certificate or after it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from gapcert.contracts.plugins.events import Stages
from gapcert.run.build import Build


@final
@dataclass(frozen=True)
class Outcome:
    """What was found: the JSON summary, the objects behind it by name, and in a sentence each what refutes a claim."""

    summary: Mapping[str, Any]
    artifacts: Mapping[str, Any] = field(default_factory=dict)
    failures: tuple[str, ...] = ()


class Study(ABC):
    """A component of kind `study`, called like the section of a spec that asks for it."""

    @abstractmethod
    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        """Carry it out in a run folder, and say what it adds.

        Where its section answers `alone`, `made` is empty and the summary has `verdict` and `reason`; else it is what the
        certificate's own run has made, with artifacts model, backend, domain, certificate and controllers.
        """
