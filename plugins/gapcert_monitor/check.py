"""Does γ still hold? New measurements against a certificate: a log, or one transition at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Interval, Model, Recording, Trajectory, UsageError
from gapcert.plugin import Coordinates, RelativeModel, Zone, damage_told, difference, magnitude, stated_units, without_units
from gapcert_monitor.thresholds import THRESHOLDS
from gapcert_recordings import Transitions, axes
from gapcert_verify import Evidence, bounds, load, verify_run, zone

if TYPE_CHECKING:
    from gapcert.plugin import Certificate, Declaration, Predictor
    from gapcert_recordings import Table

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

        Only where the certificate counts hidden states of the backend among its states is the backend built. UsageError where
        `gapcert verify` refuses the folder.
        """
        with damage_told(folder):
            return cls._loaded(Path(folder), allow_code)

    @classmethod
    def _loaded(cls, where: Path, allow_code: bool) -> Certified:
        from gapcert.plugin import Build, ModelPredictor, load_spec, regular, widen

        evidence, data = load(where), _stored(where, "spec.json")
        if failed := next((c for c in verify_run(where, allow_code)["checks"] if not c["passed"]), None):
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


@final
@dataclass(frozen=True)
class Check:
    """What a log says of a certificate. `points` transitions began in Z, `outside_domain` did not and say nothing.

    violations: [{"t", "state", "size", "gamma", "trajectory"}], |r_i| > γ_i by more than the stated noise allows, the
    `listed` largest excesses in the order of time; `violated` counts the transitions. rate = violated / points; rate_limit:
    its upper limit at 95 % (Clopper–Pearson), if transitions were independent. drift: per state, the change of r at a given z
    from the beginning to the end of the log {"change", "error", "trend"}, None with too few points. `hint`: what to do next.
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
    noise: Mapping[str, float] = field(default_factory=dict)
    hint: str = ""

    def summary(self) -> dict[str, Any]:
        """The JSON contract of `gapcert check`."""
        return {**vars(self), "violations": list(self.violations), "drift": dict(self.drift), "noise": dict(self.noise)}


def check(certified: Certified, recording: Recording, noise: Mapping[str, float] | None = None) -> Check:
    """Every transition of a recording against γ.

    noise: by how much measured channels may err, in the model's units (default: what the recording states, else 0). The
    measured residual then differs from that of the true states by at most n_i + Σ_j sup |∂f_i/∂z_j| n_j, which is allowed for;
    γ is that at the measured point.
    """
    model, steps = certified.model, Transitions.of(certified.model, recording)
    names = axes(model)
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
    unknown = r - (low + high) / 2  # without what the certificate knows of r
    drift = {s.name: _drift(unknown[:, i], gamma[:, i], z[inside]) for i, s in enumerate(model.states)}
    titles = [tr.name for tr in recording.trajectories]
    listed = _listed(steps, inside, r, gamma, excess, model, titles)
    made = Check(
        "violated" if k else ("holds" if n else "outside"),
        n,
        int((~inside).sum()),
        steps.skipped,
        listed,
        k,
        int(out.sum()),
        k / n if n else None,
        rate_limit(k, n) if n else None,
        drift,
        stated,
    )
    return replace(made, hint=_hint(made, _noisy(steps, unknown, inside, model)))


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


def _drift(r: Array, gamma: Array, z: Array) -> dict[str, Any] | None:
    """How much r (without what is known of it) changes along the log: its slope over time beside a quadratic function of z.

    What neighbours share counts once: the slope's error comes from sums over `drift_stretches` stretches. A trend is one that
    is sure and at least `drift_share` of the median γ.
    """
    from scipy.stats import t as student

    if len(r) < 4 * THRESHOLDS.drift_stretches or not np.isfinite(r).all():
        return None
    spread = z.std(axis=0)
    w = (z - z.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    first, second = np.triu_indices(w.shape[1])
    design = np.hstack([np.ones((len(w), 1)), w, w[:, first] * w[:, second]])
    if len(r) < 4 * design.shape[1]:
        return None
    time = np.linspace(-0.5, 0.5, len(r))
    both = np.stack([time, r], axis=1)
    time, left = (both - design @ np.linalg.lstsq(design, both, rcond=None)[0]).T
    size = float(time @ time)
    change = float(time @ left) / size
    scores = [float(s.sum()) for s in np.array_split(time * (left - change * time), THRESHOLDS.drift_stretches)]
    error = float(np.linalg.norm(scores)) / size
    sure = abs(change) > error * float(student.ppf((1 + THRESHOLDS.drift_level) / 2, THRESHOLDS.drift_stretches - 1))
    return {"change": change, "error": error, "trend": bool(sure and abs(change) > THRESHOLDS.drift_share * np.median(gamma))}


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
        self._certified = certified
        self.points = self.outside = self.violations = 0

    def step(self, x: Array, u: Array, x_next: Array) -> Observation:
        """x (nx,), u (nu,), held for the period, and x_next (nx,)."""
        at, given, after = (np.asarray(v, dtype=np.float64).reshape(1, -1) for v in (x, u, x_next))
        c = self._certified
        z = c.points(at, given)
        r = c.residual(at, given, after)
        if not c.zone.contains(z)[0]:
            self.outside += 1
            return Observation(False, r[0], np.full(r.shape[1], np.inf), False)
        low, high = c.band(z)
        gamma = np.maximum(np.abs(low), np.abs(high))
        # A value that is not a number does not confirm γ.
        violated = not bool((np.abs(r) <= gamma).all())
        self.points += 1
        self.violations += violated
        return Observation(True, r[0], gamma[0], violated)

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
