"""From the checked sections of a spec to the objects that they describe."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, final

from gapcert.certificate import Certificate
from gapcert.certify import Request, certify
from gapcert.components import registry
from gapcert.domain import Domain
from gapcert.events import Emit
from gapcert.gap import GapFamily
from gapcert.sampling import AdaptiveSampling, GridSampling, Sampling
from gapcert.spec import Spec, load_spec
from gapcert.system import Model, System


@final
@dataclass(frozen=True)
class Build:
    """Objects from the checked sections of a spec."""

    spec: Spec
    executor_name: str | None
    out: Path
    allow_code: bool

    def make(self, section: str, model: Model | None = None, period: float | None = None) -> Any:
        return self.spec.build(section, model=model, allow_code=self.allow_code, period=period)

    def against(self, model: Model) -> tuple[System, Domain]:
        """The backend and the domain of a model."""
        return self.make("backend", model), Domain.of(model, self.spec.config.domain or {})

    def sampling(self, domain: Domain) -> Sampling:
        config = self.spec.config.sampling
        if config is None:
            return AdaptiveSampling()
        if config.kind == "adaptive":
            return AdaptiveSampling(config.budget, config.chunk)
        if config.counts is None:
            assert config.radius is not None, "a grid is given by its counts or by its radius"
            return GridSampling.covering(domain, config.radius.states, config.radius.inputs, config.chunk)
        return GridSampling(tuple(config.counts[a.name] for a in domain.axes), config.chunk)

    def executor(self) -> Callable[[], Executor]:
        config = self.spec.config.sampling
        name = self.executor_name or (config.executor if config else "processes")
        make = registry().get("executor", name).load()
        return partial(make, config.workers if config else None)

    def family(self) -> GapFamily:
        written = self.spec.config.gap is not None
        family: GapFamily = self.make("gap") if written else registry().build("gap_family", "envelope")
        return family

    def certify(self, model: Model, backend: System, domain: Domain, folder: Path, emit: Emit) -> Certificate:
        """The certificate that the spec asks for, of any model; by default an empirical one."""
        c, asked = self.spec.config, self.spec.config.certificate
        family = self.family()
        request = (
            Request(asked.claim, asked.violation, _beta(asked.confidence), asked.attack) if asked is not None else Request()
        )
        return certify(
            model,
            backend,
            domain,
            sampling=self.sampling(domain),
            lipschitz=self.make("lipschitz.residual") if "residual" in c.lipschitz else None,
            family=family,
            predictor=self.predictor(family),
            route=asked.route if asked is not None else None,
            request=request,
            seed=c.seed,
            folder=folder,
            ledger=self.out / "ledger.json",
            executor=self.executor(),
            emit=emit,
        )

    def predictor(self, family: GapFamily) -> Model | None:
        """The extended model of `predictor: {model: PATH}`, a spec whose `model:` section is used."""
        path = getattr(family.predictor, "model", None)
        if path is None:
            return None
        model: Model = load_spec(self.spec.folder / path).build("model", allow_code=self.allow_code)
        return model


def _beta(confidence: float) -> float:
    """1 − confidence, from the decimal that was written: 0.999999 means 1e-6, not 1.00000000002876e-6."""
    return float(1 - Decimal(repr(confidence)))
