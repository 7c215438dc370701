"""What a certificate is about, ready to be held against measurements: from a certificate, or from the folder of its run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import Array, Coordinates, Interval, Model, RelativeModel, UsageError, Zone, damage_told, difference
from gapcert_verify import Evidence, bounds, load, zone

if TYPE_CHECKING:
    from gapcert.plugin import Certificate, Declaration, Predictor

Band = Callable[[Array], tuple[Array, Array]]


@final
@dataclass(frozen=True)
class Certified:
    """What a certificate is about: the model f, the set Z, and (l, u) at points of it.

    `relative`: where Z and the band are in coordinates (x, w) and the model in (x, u), how w is made.
    """

    model: Model
    zone: Zone
    band: Band
    relative: Coordinates | None = None

    @classmethod
    def of(cls, certificate: Certificate | Declaration) -> Certified:
        """UsageError where the certificate has lost its model, as one that was unpickled without it."""
        model = certificate.model
        if model is None:
            raise UsageError(
                "check: the certificate holds no model; expected one from `certify` or a run; give the run's folder"
            )
        relative = model.relative if isinstance(model, RelativeModel) else None
        f = model.inner if isinstance(model, RelativeModel) else model
        assert isinstance(f, Model), "the nominal side of a certificate is a model"
        return cls(f, certificate.domain.zone, certificate.gap.interval, relative)

    @classmethod
    def load(cls, folder: Path | str, allow_code: bool = False) -> Certified:
        """From a run's folder: its spec makes the model, its stored certificate the band; the backend is not needed.

        Only where the certificate counts hidden states of the backend among its states is the backend built.
        """
        with damage_told(folder):
            return cls._loaded(Path(folder), allow_code)

    @classmethod
    def _loaded(cls, where: Path, allow_code: bool) -> Certified:
        from gapcert.plugin import Build, ModelPredictor, load_spec, regular, widen

        evidence, data = load(where), _stored(where, "spec.json")
        home = Path(_stored(where, "run.json").get("folder", "."))
        # What is not asked for need not be there: neither engines nor their files.
        only = {k: data[k] for k in ("version", "name", "model")}
        model: Model = load_spec(only, folder=home).build("model", allow_code=allow_code)
        extended: Model | None = None
        if evidence.data["predictor"] == "model":
            named = home / data["gap"]["predictor"]["model"]
            if not regular(named):
                raise UsageError(f"{named}: there is no such file; expected the extended model that the certificate names")
            extended = load_spec(named).build("model", allow_code=allow_code)
        if evidence.data["domain"]["states"] != model.nx:
            backend, domain = Build(load_spec(data, folder=home), None, where.parent, allow_code).against(model)
            model, _ = widen(model, backend, domain)
            extended = None if extended is None else widen(extended, backend, domain)[0]
        relative = Coordinates.of(model, data["coordinates"]) if data.get("coordinates") else None
        p = None
        if extended is not None:
            pair = (
                (extended, model) if relative is None else (RelativeModel(extended, relative), RelativeModel(model, relative))
            )
            p = ModelPredictor(*pair)
        return cls(model, zone(evidence.data), _stored_band(evidence, p), relative)

    def points(self, x: Array, u: Array) -> Array:
        """z (n, nz) in the coordinates of Z; angles on the turn that is nearest to the middle of Z."""
        z = np.hstack([x, u])
        for j, axis in enumerate(self.model.states):
            if axis.kind == "angle":
                middle = (self.zone.low[j] + self.zone.high[j]) / 2
                turns = np.round((z[:, j] - middle) / (2 * np.pi))
                # A whole turn is subtracted only where there is one: it is rounded.
                z[:, j] = np.where(turns != 0, z[:, j] - 2 * np.pi * turns, z[:, j])
        return z if self.relative is None else self.relative.over(Interval.exact(z)).mid

    def residual(self, x: Array, u: Array, x_next: Array) -> Array:
        """r = x⁺ − f(x, u), (n, nx)."""
        return difference(self.model.states, x_next, self.model.step(x, u).x)


def _stored(folder: Path, name: str) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError("it holds no object")
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{folder / name}: cannot be read ({error}); expected the folder of a finished run") from None
    return found


def _stored_band(evidence: Evidence, p: Predictor | None) -> Band:
    def band(z: Array) -> tuple[Array, Array]:
        e = evidence if p is None else replace(evidence, arrays={**evidence.arrays, "predictor.check": p(z)})
        low, high = bounds(e, z, "predictor.check")
        return low.lo, high.hi

    return band
