"""From the checked sections of a spec to the objects that they describe."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

from gapcert.certification.certificate import Certificate
from gapcert.certification.certify import certify
from gapcert.certification.coordinates import Coordinates, RelativeGap, RelativeModel, RelativeSystem
from gapcert.certification.declaration import Declaration
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.gates.augment import augment, augment_model, unmeasured, widen
from gapcert.certification.gates.hidden_state import HiddenPlan
from gapcert.certification.routes import Request
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling, LatticeSampling, Sampling
from gapcert.certification.samples.executors import named
from gapcert.certification.samples.extremes import Extremes
from gapcert.contracts.data.units import magnitude
from gapcert.contracts.gaps.claim import beta_of
from gapcert.contracts.gaps.gap import GapFamily, GapFunction
from gapcert.contracts.plugins.events import Emit
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System
from gapcert.spec.spec import Spec


@final
@dataclass(frozen=True)
class Build:
    """Objects from the checked sections of a spec. hidden_later: those that it declares, a backend need not have yet."""

    spec: Spec
    executor_name: str | None
    out: Path
    allow_code: bool
    hidden_later: bool = False

    def make(self, section: str, model: Model | None = None, period: float | None = None) -> Any:
        return self.spec.build(section, model=model, allow_code=self.allow_code, period=period)

    def with_sections(self, **sections: Any) -> Build:
        """The same of a spec with these in place of its own."""
        return replace(self, spec=replace(self.spec, config=replace(self.spec.config, **sections)))

    def against(self, model: Model) -> tuple[System, Domain]:
        """The backend and the domain of a model."""
        c = self.spec.config
        backend: System = self.make("backend" if c.backend is not None else "reality", model)
        ranges = dict(c.domain or {})
        if c.hidden.mode != "augment":
            return backend, Domain.of(model, ranges, c.relations)
        added = self.hidden_ranges(backend, "domain")
        backend, model = augment(backend, list(added)), augment_model(model, backend, list(added))
        return backend, Domain.of(model, ranges | added, c.relations)

    def remembered(self, model: Model, backend: System) -> tuple[Model, System]:
        """With what the model remembers as hidden state of the pair, where the spec declares ranges for all of it, or asks for
        the default of all hidden state.
        """
        config = self.spec.config.hidden
        if config.mode == "default":
            return unmeasured(model, backend, [s.name for s in model.hidden])
        return unmeasured(model, backend, config.ranges if config.mode == "sample" else ())

    def hidden_ranges(self, backend: System, section: str) -> dict[str, tuple[float, float]]:
        """Declared ranges of hidden states in the backend's units."""
        config, units = self.spec.config.hidden, {h.name: h.unit for h in backend.hidden}
        out: dict[str, tuple[float, float]] = {}
        for name, bounds in config.ranges.items():
            if name not in units and self.hidden_later:
                continue
            if name not in units:
                known = ", ".join(units) or "none"
                raise self.spec.error(f"{section}.{name}", f"'{name}' is no hidden state of the backend", f"it has {known}")
            try:
                low, high = (magnitude(b, units[name]) for b in bounds)
            except ValueError as error:
                raise self.spec.error(f"{section}.{name}", str(error)) from None
            out[name] = (low, high)
        return out

    def plan(self, backend: System) -> HiddenPlan:
        """What the spec wants done about hidden state."""
        config = self.spec.config.hidden
        if config.mode != "sample":
            return HiddenPlan(config.mode)
        assert config.sample is not None, "mode sample comes from a section that says how"
        ranges, pool = self.hidden_ranges(backend, "hidden.sample.ranges"), config.sample.visited
        if pool is None:
            return HiddenPlan("sample", ranges, safety=config.sample.safety)
        return HiddenPlan("sample", {}, pool.runs, pool.steps, pool.near, config.sample.safety)

    def relative(self, model: Model, backend: System, domain: Domain) -> tuple[Model, System, Domain]:
        """What is certified: in the coordinates that the spec asks for, inputs measured relative to the states."""
        if not self.spec.config.coordinates:
            return model, backend, domain
        c = Coordinates.of(model, self.spec.config.coordinates)
        relative = RelativeModel(backend, c) if isinstance(backend, Model) else RelativeSystem(backend, c)
        return RelativeModel(model, c), relative, c.domain(domain)

    def absolute(self, gap: GapFunction, model: Model) -> GapFunction:
        """A gap function that was certified in those coordinates, as one of (x, u)."""
        given = self.spec.config.coordinates
        return RelativeGap(gap, Coordinates.of(model, given)) if given else gap

    def sampling(self, domain: Domain, axes: Sequence[str]) -> Sampling:
        """Of a domain whose axes have these names in the spec."""
        config = self.spec.config.sampling
        if config is None:
            return AdaptiveSampling()
        if config.kind == "adaptive":
            return AdaptiveSampling(config.budget, config.chunk, tightness=config.tightness)
        if config.kind == "lattice":
            counts = None if config.counts is None else tuple(config.counts[name] for name in axes)
            return LatticeSampling(counts, config.budget, config.chunk)
        if config.counts is None:
            assert config.radius is not None, "a grid is given by its counts or by its radius"
            grid = GridSampling.covering(domain, config.radius.states, config.radius.inputs, config.chunk)
        else:
            grid = GridSampling(tuple(config.counts[name] for name in axes), config.chunk)
        if config.keep == "all":
            return grid
        cells = config.cells
        return replace(
            grid, cells=Extremes.default_cells(grid.counts) if cells is None else tuple(cells[name] for name in axes)
        )

    def executor(self) -> Callable[[], Executor]:
        """What `--executor` names, else the spec: NAME or NAME:ADDRESS."""
        config = self.spec.config.sampling
        make = named(self.executor_name or (config.executor if config else "processes"))
        return partial(make, config.workers if config else None)

    def family(self) -> GapFamily:
        written = self.spec.config.gap is not None
        family: GapFamily = self.make("gap") if written else registry().build("gap_family", "envelope")
        return family

    def certify(self, model: Model, backend: System, domain: Domain, folder: Path, emit: Emit) -> Certificate:
        """The certificate that the spec asks for, of any model; by default an empirical one."""
        where: dict[str, Any] = {"folder": folder, "ledger": self.out / "ledger.json", "executor": self.executor()}
        made = certify(**self.asked(model, backend, domain), **where, emit=emit)
        return replace(made, versions={**made.versions, **self.versions()})

    def asked(self, model: Model, backend: System, domain: Domain) -> dict[str, Any]:
        """What `certify` is asked, by the names of its arguments."""
        c, asked = self.spec.config, self.spec.config.certificate
        family = self.family()
        request = (
            Request(asked.claim, asked.violation, beta_of(asked.confidence), asked.attack, asked.exceedances, asked.repeats)
            if asked is not None
            else None
        )
        # As the run itself asks it: with hidden states that the domain names as states, but in the coordinates of the domain.
        model, backend = widen(model, backend, domain)
        question, axes = Fingerprint(model, backend, domain), [a.name for a in domain.axes]
        extended = self.predictor(family, backend, domain)
        model, backend, domain = self.relative(model, backend, domain)
        return {
            "model": model,
            "backend": backend,
            "domain": domain,
            "question": question,
            "sampling": None if c.sampling is None and "seed" in backend.capabilities else self.sampling(domain, axes),
            "lipschitz": self.make("lipschitz.residual") if "residual" in c.lipschitz else None,
            "family": family,
            "predictor": extended,
            "route": asked.route if asked is not None else None,
            "request": request,
            "symmetries": c.symmetries.translation if c.symmetries is not None else (),
            "hidden": self.plan(backend),
            "seed": c.seed,
        }

    def declare(self, model: Model, domain: Domain) -> Declaration:
        """γ as the spec states it, where it names no backend."""
        f, _, z = self.relative(model, model, domain)
        gap = self.family().stated([s.name for s in f.states])
        assert gap is not None, "without a backend, γ is declared"
        made = Declaration(gap, f, z)
        return replace(made, versions={**made.versions, **self.versions()})

    def versions(self) -> dict[str, str]:
        """Those of the packages that the components of this spec are made of."""
        c, found = self.spec.config, dict[str, str]()
        parts = [c.backend, c.reality, c.gap, c.recording, *c.lipschitz.values()]
        kinds, system = {p.kind for p in parts if p is not None}, c.backend or c.reality
        if system is not None and self.spec.component("backend" if c.backend is not None else "reality").of:
            kinds.add(system.of.kind)
        for module in (m for part in registry().components.values() if part.name in kinds for m in part.requires):
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                found[module] = importlib.metadata.version(module)
        return found

    def predictor(self, family: GapFamily, backend: System, domain: Domain) -> Model | None:
        """The extended model that a family subtracts, over what is certified."""
        if not isinstance(family.predictor, Model):
            return None
        model, _ = widen(family.predictor, backend, domain)
        given = self.spec.config.coordinates
        return RelativeModel(model, Coordinates.of(model, given)) if given else model
