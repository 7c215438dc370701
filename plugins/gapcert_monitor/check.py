"""Does γ still hold? New measurements against a certificate: a log, or one transition at a time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Claim, Interval, Model, Recording, Trajectory, UsageError
from gapcert.plugin import (
    Band,
    Box,
    Coordinates,
    Domain,
    Ints,
    RelativeModel,
    Statement,
    Zone,
    circle,
    damage_told,
    difference,
    magnitude,
    order_statistics,
    stated_units,
    without_units,
)
from gapcert_bounds import calibrated, stored
from gapcert_monitor.thresholds import THRESHOLDS
from gapcert_recordings import Copies, Transitions, axes
from gapcert_verify import Evidence, bounds, load, verify_run

from .drift import drift as _drift

if TYPE_CHECKING:
    from gapcert.plugin import Predictor
    from gapcert_recordings import Table


@final
@dataclass(frozen=True)
class Certified(Statement):
    """What a certificate is about: the model f, the set Z, (l, u) at points of it, and what is claimed of them.

    `relative`: where Z and the band are in coordinates (x, w) and the model in (x, u), how w is made. window: in s, where the
    claim is about windows of recordings; None there: about whole trajectories.
    """

    model: Model
    zone: Zone
    band: Band
    relative: Coordinates | None = None
    claim: Claim | None = None
    window: float | None = None

    @cached_property
    def domain(self) -> Domain:
        """Z with its names and units."""
        (low, high), nx = (self.zone.low, self.zone.high), self.model.nx
        inputs = self.model.inputs if self.relative is None else self.relative.axes
        return Domain(Box(self.model.states, low[:nx], high[:nx]), Box(inputs, low[nx:], high[nx:]), self.zone.relations)

    def _about(self) -> tuple[Domain, Band]:
        return self.domain, self.band

    @classmethod
    def of(cls, certificate: Any) -> Certified:
        """Of any statement; UsageError where it has lost its model, as a certificate that was unpickled without it."""
        if isinstance(certificate, Certified):
            return certificate
        model = certificate.model
        if model is None:
            raise UsageError(
                "check: the certificate holds no model; expected one from `certify` or a run; give the run's folder"
            )
        relative = model.relative if isinstance(model, RelativeModel) else None
        f = model.inner if isinstance(model, RelativeModel) else model
        assert isinstance(f, Model), "the nominal side of a certificate is a model"
        return cls(
            f,
            certificate.domain.zone,
            certificate.gap.interval,
            relative,
            certificate.claim,
            getattr(certificate, "window", None),
        )

    @classmethod
    def load(cls, folder: Path | str, allow_code: bool = False) -> Certified:
        """From a run's folder: its spec makes the model, its stored certificate the band; the backend is not needed.

        Only where the certificate counts hidden states of the backend among its states is the backend built. UsageError where
        `gapcert verify` refuses the folder.
        """
        with damage_told(folder):
            return cls._loaded(Path(folder), allow_code)

    @classmethod
    def _loaded(cls, where: Path, allow_code: bool) -> Certified:
        from gapcert.plugin import Build, ModelPredictor, load_spec, regular, widen

        evidence, data = load(where), _stored(where, "spec.json")
        if failed := next((c for c in verify_run(where, allow_code=allow_code)["checks"] if not c["passed"]), None):
            raise UsageError(f"{where}: is not what it claims ({failed['check']}: {failed['detail']}); run the spec again")
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
        band, middle = _stored_band(evidence, p), np.add(evidence.zone.low, evidence.zone.high)[None] / 2
        if (found := band(middle)[0].shape) != (1, model.nx):
            raise ValueError(f"the band has the shape {found} at a point; expected one value for each of {model.nx} states")
        claim, window = Claim(**evidence.data["claim"]), (data.get("certificate") or {}).get("window")
        length = None if window is None else magnitude(window, "s")
        return cls(model, evidence.zone, band, relative, claim, length)

    def points(self, x: Array, u: Array) -> Array:
        """z (n, nz) in the coordinates of Z; angles on the turn of Z."""
        z = np.concatenate([x, u], axis=1)
        for j, low, high in self._turning:
            z[:, j] = circle.onto(low, high, z[:, j])
        if self.relative is None:
            return z
        (slope, scale), nx = self._shifted, self.model.nx
        w = z[:, nx:] * scale
        for j in range(nx):  # in this order in batches of any size
            w += z[:, j : j + 1] * slope[j]
        return np.hstack([z[:, :nx], w])

    @cached_property
    def _shifted(self) -> tuple[Array, Array]:
        """Slopes (nx, nu) and scales (nu,) of relative inputs."""
        assert self.relative is not None, "inputs are relative"
        held = self.relative.arrays()
        return np.ascontiguousarray(held["slope_of_w"].T), held["scale_of_w"]

    @cached_property
    def _turning(self) -> list[tuple[int, float, float]]:
        """(axis, ends of Z along it) of the states that are angles."""
        kinds = (axis.kind for axis in self.model.states)
        return [(j, self.zone.low[j], self.zone.high[j]) for j, kind in enumerate(kinds) if kind == "angle"]

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
    """As the certificate computes it, where its gap function can be made again; else by intervals around it."""
    own = {k.removeprefix("gap."): v for k, v in evidence.arrays.items() if k.startswith("gap.")}
    made = stored(evidence.data["form"], own, evidence.zone, p)
    if made is not None and "calibrated.widening" not in own:
        return made.interval
    if made is not None:
        return lambda z: calibrated(*made.interval(z), own["calibrated.widening"], own["calibrated.resolution"])

    def band(z: Array) -> tuple[Array, Array]:
        e = evidence if p is None else replace(evidence, arrays={**evidence.arrays, "predictor.check": p(z)})
        low, high = bounds(e, z, "predictor.check")
        return low.lo, high.hi

    return band


@final
@dataclass(frozen=True)
class Check:
    """What a log says of a certificate. `points` transitions began in Z, `outside_domain` did not and say nothing.

    violations: [{"t", "state", "size", "gamma", "trajectory"}], |r_i| > γ_i by more than the stated noise allows, the
    `listed` largest excesses in the order of time; `violated` counts the transitions. rate = violated / points; rate_limit:
    its upper limit at 95 % (Clopper–Pearson), if transitions were independent. The verdict is `violated` where the claim is
    refuted: more of its `units` (transitions, or windows) have a violation than are `allowed`, see `tolerated`. drift: per
    state, the change of r at a given z from the beginning to the end of the log, see `drift`. copies: what is in the log twice,
    and counts once. `hint`: what to do next.
    """

    verdict: Literal["holds", "violated", "outside"]
    points: int
    outside_domain: int
    skipped: int
    violations: tuple[dict[str, Any], ...]
    violated: int
    band_violations: int
    rate: float | None
    rate_limit: float | None
    drift: Mapping[str, Mapping[str, Any] | None]
    copies: Copies
    noise: Mapping[str, float] = field(default_factory=dict)
    hint: str = ""
    units: int = 0
    allowed: int = 0

    def summary(self) -> dict[str, Any]:
        """The JSON contract of `gapcert check`."""
        lists = {"violations": list(self.violations), "copies": self.copies.summary()}
        return {**vars(self), **lists, "drift": dict(self.drift), "noise": dict(self.noise)}


def check(certified: Certified, recording: Recording, noise: Mapping[str, float] | None = None) -> Check:
    """Every transition of a recording against γ.

    noise: by how much measured channels may err, in the model's units (default: what the recording states, else 0). The
    measured residual then differs from that of the true states by at most n_i + Σ_j sup |∂f_i/∂z_j| n_j, which is allowed for;
    γ is that at the measured point.
    """
    model = certified.model
    copies = Copies.of(recording, [s.name for s in model.inputs])
    recording = copies.without(recording)
    steps, names = Transitions.of(model, recording), axes(model)
    stated = {**{n: e for n, e in recording.noise.items() if n in names}, **(noise or {})}
    if others := [n for n in stated if n not in names]:
        raise UsageError(f"noise: '{others[0]}' is no state or input; there are {', '.join(names)}")
    if wrong := [n for n, e in stated.items() if not (np.isfinite(e) and e >= 0)]:
        raise UsageError(f"noise: {wrong[0]} = {stated[wrong[0]]}; expected a number ≥ 0 in the model's unit")
    z = certified.points(steps.x, steps.u)
    inside = certified.zone.contains(z)
    r = certified.residual(steps.x[inside], steps.u[inside], steps.x_next[inside])
    low, high = certified.band(z[inside]) if inside.any() else (r, r)
    gamma = np.maximum(np.abs(low), np.abs(high))
    allowed = _allowance(model, np.hstack([steps.x, steps.u])[inside], np.array([stated.get(n, 0.0) for n in names]))
    # What is not a number confirms nothing.
    excess = np.nan_to_num(np.abs(r) - gamma - allowed, nan=np.inf)
    over = (excess > 0).any(axis=1)
    out = ~((r >= low - allowed) & (r <= high + allowed)).all(axis=1)
    n, k = int(inside.sum()), int(over.sum())
    unit = _units(certified, steps, recording)[inside]
    units, hit = len(np.unique(unit)), len(np.unique(unit[over]))
    most = tolerated(certified.claim, units)
    unknown = r - (low + high) / 2  # without what the certificate knows of r
    drift = {s.name: _drift(unknown[:, i], gamma[:, i], z[inside]) for i, s in enumerate(model.states)}
    titles = [tr.name for tr in recording.trajectories]
    listed = _listed(steps, inside, r, gamma, excess, model, titles)
    made = Check(
        "violated" if hit > most else ("holds" if n else "outside"),
        n,
        int((~inside).sum()),
        steps.skipped,
        listed,
        k,
        int(out.sum()),
        k / n if n else None,
        rate_limit(k, n) if n else None,
        drift,
        copies,
        stated,
        units=units,
        allowed=most,
    )
    return replace(made, hint=_hint(made, _noisy(steps, unknown, inside, model)))


def tolerated(claim: Claim | None, units: int) -> int:
    """With how many violations among so many units a claim still stands at its own level.

    A statistical one is refuted by v where P(Bin(units, ε) ≥ v) ≤ β, or ≤ 5 % where it states no β, as if units were
    independent and of its distribution. All others are about every transition.
    """
    if claim is None or claim.kind != "statistical" or claim.epsilon is None or not units:
        return 0
    level = 1 - THRESHOLDS.confidence if claim.beta is None else claim.beta
    return order_statistics.surprising(units, claim.epsilon, level) - 1


def _units(certified: Certified, steps: Transitions, recording: Recording) -> Ints:
    """Which unit of the claim each transition (n,) is of: itself, its window, or its trajectory."""
    claim = certified.claim
    if claim is None or claim.distribution not in (order_statistics.WINDOWS, order_statistics.DRAWN_WINDOWS):
        return np.arange(len(steps))
    if certified.window is None:
        return steps.trajectory
    first = np.array([np.nanmin(tr.t) for tr in recording.trajectories])[steps.trajectory]
    number = np.floor((steps.t - first) / certified.window + 1e-9).astype(np.int64)
    return np.unique(np.stack([steps.trajectory, number], axis=1), axis=0, return_inverse=True)[1].reshape(-1)


def rate_limit(k: int, n: int, confidence: float = THRESHOLDS.confidence) -> float:
    """One-sided upper limit of a probability of which k of n independent trials were hits (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    return 1.0 if k >= n else float(beta.ppf(confidence, k + 1, n - k))


def _allowance(model: Model, z: Array, noise: Array) -> Array:
    """(n, nx) n_i + Σ_j sup |∂f_i/∂z_j| n_j over the box of half-widths `noise` around each point."""
    if not noise.any():
        return np.zeros((len(z), model.nx))
    slope = model.jacobian_enclosure(Interval.around(z, noise)).mag
    return np.asarray((noise[: model.nx] + (slope * noise).sum(axis=2)) * (1 + 1e-12))


def _listed(
    steps: Transitions, inside: npt.NDArray[np.bool_], r: Array, gamma: Array, excess: Array, model: Model, titles: list[str]
) -> tuple[dict[str, Any], ...]:
    row, state = np.nonzero(excess > 0)
    worst = np.sort(np.argsort(-excess[row, state] / np.maximum(gamma[row, state], 1e-300), kind="stable")[: THRESHOLDS.listed])
    t, of = steps.t[inside], steps.trajectory[inside]
    return tuple(
        {
            "t": float(t[k]),
            "state": model.states[i].name,
            "size": float(abs(r[k, i])),
            "gamma": float(gamma[k, i]),
            "trajectory": titles[of[k]],
        }
        for k, i in zip(row[worst].tolist(), state[worst].tolist(), strict=True)
    )


def _hint(found: Check, noisy: Mapping[str, float]) -> str:
    if found.verdict == "outside":
        return (
            "No transition of the log begins in the certificate's domain: it says nothing about them; certify a larger domain."
        )
    if found.verdict == "violated":
        states = list(dict.fromkeys(v["state"] for v in found.violations))
        loud = {n: e for n, e in noisy.items() if n in states and not found.noise.get(n)}
        if loud:
            n, e = next(iter(loud.items()))
            return (
                f"The residual of {n} turns back from one transition to the next as noise in its measurement would make it "
                f"(by about {e:.3g}): state how exact the log is (--noise {n}=VALUE), or measure it better."
            )
        return (
            f"γ is exceeded in {', '.join(states)}: run `gapcert diagnose` on a spec with this model and `recording:` of this "
            f"log to learn why."
        )
    if found.violated:
        return (
            f"γ is exceeded, but no more often than the claim allows: its ε is refuted by violations in more than "
            f"{found.allowed} of {found.units:,}."
        )
    if trends := [n for n, d in found.drift.items() if d is not None and d["trend"]]:
        return f"The residual of {', '.join(trends)} drifts along the log, still below γ; `gapcert diagnose` may tell why."
    return ""


def _noisy(steps: Transitions, r: Array, inside: npt.NDArray[np.bool_], model: Model) -> dict[str, float]:
    """Per state whose residual looks like noise in the measurement, its standard deviation.

    x⁺ enters one residual and x the next with the other sign, so independent errors of a sample correlate neighbours by about
    −1/2, and what the model lacks, which changes little from one step to the next, by more than 0.
    """
    first, second = steps.followed(inside, model.period)
    if len(first) < THRESHOLDS.neighbours:
        return {}
    centred = r - r.mean(axis=0)
    size = np.maximum((centred**2).mean(axis=0), np.finfo(float).tiny)
    turned = (centred[first] * centred[second]).mean(axis=0) / size
    return {s.name: float(np.sqrt(size[i] / 2)) for i, s in enumerate(model.states) if turned[i] < THRESHOLDS.noise_correlation}


def in_words(found: Check) -> list[str]:
    """For the terminal."""
    lines = [
        f"{found.verdict}: |r| > γ in {found.violated} of {found.points:,} transitions in the domain"
        + (
            f" ({100 * found.rate:.3g} %, below {100 * (found.rate_limit or 0):.3g} % at 95 % if they were independent)"
            if found.rate is not None
            else ""
        ),
        f"{found.outside_domain:,} transitions began outside the domain, {found.skipped:,} rows began none of one period",
    ]
    worst = sorted(found.violations, key=lambda v: -v["size"] / max(v["gamma"], 1e-300))[:5]
    lines += [f"  t = {v['t']:.6g} s: |r| of {v['state']} is {v['size']:.4g}, γ is {v['gamma']:.4g}" for v in worst]
    trends = {n: d for n, d in found.drift.items() if d is not None and d["trend"]}
    lines += [f"  {found.copies.told}"] if found.copies.found else []
    lines += [f"  {n} drifts by {d['change']:.3g} (± {d['error']:.2g}) along the log" for n, d in trends.items()]
    return [*lines, *([found.hint] if found.hint else [])]


@final
class Observation(NamedTuple):
    """One transition: did it begin in Z, r (nx,), γ (nx,) (∞ outside Z), and is |r_i| > γ_i for some i?"""

    inside: bool
    residual: Array
    gamma: Array
    violated: bool


@final
class Monitor:
    """γ watched online: `step` takes one measured transition of one period, and counts."""

    def __init__(self, certified: Certified) -> None:
        axes(certified.model)
        self._certified, zone = certified, certified.zone
        # Where Z is a box in (x, u) itself, of no more than a turn, a point between its ends is in it as it stands.
        whole = any(zone.high[j] - zone.low[j] > circle.TURN for j, s in enumerate(certified.model.states) if s.kind == "angle")
        plain = certified.relative is None and not zone.relations and not whole
        self._ends = list(zip(zone.low, zone.high, strict=True)) if plain else []
        self.points = self.outside = self.violations = 0

    def step(self, x: Array, u: Array, x_next: Array) -> Observation:
        """x (nx,), u (nu,), held for the period, and x_next (nx,)."""
        at, given, after = (np.array(v, dtype=np.float64, ndmin=2) for v in (x, u, x_next))
        c = self._certified
        r, z = c.residual(at, given, after)[0], np.concatenate([at, given], axis=1)
        if not (self._ends and all(a <= v <= b for v, (a, b) in zip(z[0].tolist(), self._ends, strict=True))):
            z = c.points(at, given)
            if not c.zone.contains(z)[0]:
                self.outside += 1
                return Observation(False, r, np.full(len(r), np.inf), False)
        low, high = c.band(z)
        gamma = np.maximum(np.abs(low[0]), np.abs(high[0]))
        # A value that is not a number does not confirm γ.
        violated = not all(abs(a) <= b for a, b in zip(r.tolist(), gamma.tolist(), strict=True))
        self.points += 1
        self.violations += violated
        return Observation(True, r, gamma, violated)

    @property
    def rate(self) -> float | None:
        """Violations per transition that began in Z."""
        return self.violations / self.points if self.points else None

    @property
    def rate_limit(self) -> float | None:
        """Upper limit of the rate at 95 %, if transitions were independent."""
        return rate_limit(self.violations, self.points) if self.points else None


def read_log(path: Path | str, certified: Certified) -> Recording:
    """A log by its columns, which bear the names of states and inputs; or the recording of a spec, which maps them."""
    from gapcert.plugin import load_spec
    from gapcert_recordings import inspect

    where = Path(path)
    if where.suffix in (".yaml", ".yml"):
        spec = load_spec(where)
        if spec.config.recording is None:
            raise UsageError(f"{path}: the spec has no recording; expected a log, or the spec of a diagnosis")
        return spec.recorded()
    tables, names = inspect(where), axes(certified.model)
    named = [(t, without_units(c.name for c in t.columns)) for t in tables]
    whole = [(t, [(n, of[n]) for n in names]) for t, of in named if t.time is not None and set(names) <= of.keys()]
    if not whole:
        columns = [*dict.fromkeys(c.name for t in tables for c in t.columns)]
        lacking = next((n for n in names if not any(n in of for _, of in named)), None)
        what = f"no column '{lacking}'" if lacking else "no table with the times (time or t) and all of " + ", ".join(names)
        raise UsageError(
            f"{path}: {what} (there are {', '.join(columns)}); expected the times and columns {', '.join(names)}, in the "
            f"model's units or with their own, '{names[0]} [{certified.model.states[0].unit}]'; the spec of a diagnosis, whose "
            f"`recording:` maps other names, serves as well"
        )
    return Recording(tuple(_trajectory(t, dict(of), certified.model) for t, of in whole))


def _trajectory(table: Table, columns: Mapping[str, str], model: Model) -> Trajectory:
    """Of the columns that channels have, in the model's units."""
    values = {c.name: c.values for c in table.columns}
    own = Trajectory(table.t, {n: values[c] for n, c in columns.items()}, table.name)
    units = {n: unit for n, c in columns.items() for unit in stated_units([c]).values()}
    to = {s.name: s.unit for s in (*model.states, *model.inputs) if s.name in units}
    return Recording((own,), units).converted(to).trajectories[0]


def stated_noise(texts: Sequence[str], certified: Certified) -> dict[str, float]:
    """From texts such as `theta=0.1 deg`, in the model's units."""
    units = {s.name: s.unit for s in (*certified.model.states, *certified.model.inputs)}
    out = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            out[name] = magnitude(value, units.get(name, "1"))
        except ValueError as error:
            raise UsageError(f"--noise {text}: {error}; write CHANNEL=VALUE") from None
    return out
