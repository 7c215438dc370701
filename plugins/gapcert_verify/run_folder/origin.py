"""Whence a run folder's certificate is: its spec built once more, by the ordinary build, and held against what is stored.

The only part of this package that knows models, backends and specs. What it proves nothing with is left to the others: it says
what was asked, of what, and steps f and f̂ again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    AffinePredictor,
    Array,
    Build,
    Claim,
    Domain,
    Gate,
    LipschitzProblem,
    MissingDependency,
    Model,
    ModelPredictor,
    Predictor,
    Request,
    Residual,
    Samples,
    Symmetry,
    UsageError,
    __version__,
    difference,
    digest,
    domain_data,
    load_spec,
    open_gate,
    overpowered,
    registry,
    repeating,
    responses,
    stored,
    symmetric,
    widen,
)
from gapcert_verify.calibration import draws
from gapcert_verify.calibration import names as calibrations
from gapcert_verify.evidence import Evidence, bounds
from gapcert_verify.evidence import predictor as predicted_by
from gapcert_verify.sentences import states

_SAME = 1e-9  # relative: figures that were added up in another order


@final
@dataclass(frozen=True)
class Origin:
    """What a run asked. asked: the arguments of `certify`, as far as they can be made here; `whole`: with the backend, which
    is text where `why` is empty; else it says why not.
    """

    build: Build
    asked: Mapping[str, Any]
    whole: bool
    why: str = ""

    @property
    def text(self) -> bool:
        """Is every step an equation of the spec, so that all may be stepped again?"""
        return self.whole and not self.why

    @property
    def model(self) -> Model:
        made: Model = self.asked["model"]
        return made

    @property
    def domain(self) -> Domain:
        made: Domain = self.asked["domain"]
        return made

    @cached_property
    def gate(self) -> Gate:
        """What hidden state made of the backend, as `certify` found it."""
        a = self.asked
        by, family = registry().build("route", self.route), a["family"]
        _, backend = by.prepared(self.request, family, a["backend"], a["seed"])
        plan = replace(a["hidden"], ignore=(*a["hidden"].ignore, *a["symmetries"]))
        return open_gate(a["model"], backend, a["domain"], plan, a["seed"])

    @property
    def route(self) -> str:
        return str(self.asked["route"] or self.asked["family"].routes[0])

    @property
    def request(self) -> Request:
        found: Request | None = self.asked["request"]
        return found or Request(registry().build("route", self.route).claim)

    @cached_property
    def residual(self) -> Residual:
        return Residual(self.gate.system, self.model)

    @cached_property
    def audited(self) -> Residual:
        """What audit and attack ask: harmless hidden state is drawn there."""
        return Residual(self.gate.audited or self.gate.system, self.model)


def origin(folder: Path, allow_code: bool = False, engine: bool = False) -> Origin | str:
    """The origin of a run folder, or why it cannot be had; UsageError where the spec is another one than was run.

    engine: the backend is built, whatever it is; else only one that is text.
    """
    if not (folder / "spec.json").exists():
        return "there is no spec beside the certificate"
    mark, data = stored(folder, "run.json"), stored(folder, "spec.json")
    if mark is None or data is None:
        raise UsageError(f"{folder}: spec.json or run.json cannot be read")
    home = Path(mark.get("folder", "."))
    if lost := [name for name in mark.get("files", {}) if not (home / name).exists()]:
        return f"{lost[0]}, which the spec names, is not there"
    try:
        spec = load_spec(data, folder=home)
        if not f"{mark['name']}-".startswith(f"{spec.config.name}-"):  # one of a matrix has words more
            raise UsageError(f"{folder}: spec.json is of {spec.config.name}, and {mark['name']} was run")
        spec = replace(spec, config=replace(spec.config, name=mark["name"]))
        if spec.digest != mark["spec"]:
            raise UsageError(f"{folder}: spec.json, or a file that it names, is another one than was run")
        return _built(Build(spec, None, folder.parent, allow_code), engine)
    except MissingDependency as error:
        return str(error)


def _built(build: Build, engine: bool) -> Origin | str:
    c = build.spec.config
    code = [name for name in ("model", "backend") if getattr(c, name) is not None and build.spec.component(name).code]
    if code and not build.allow_code:
        return f"the {code[0]} is code, which runs with --allow-code alone"
    model: Model = build.make("model")
    why = "" if c.backend is None or _text(build) else f"the backend is no text ({c.backend.kind})"
    if c.backend is not None and (engine or not why or c.hidden.mode == "augment"):
        backend, domain = build.against(model)
        model, backend = widen(model, backend, domain)
        return Origin(build, build.asked(*build.remembered(model, backend), domain), True, why)
    # As for a declared γ: the model stands in for the backend, where only names and ranges are asked.
    alone = build.with_sections(hidden=type(c.hidden)())
    return Origin(build, alone.asked(model, model, Domain.of(model, dict(c.domain or {}), c.relations)), False, why)


def _text(build: Build) -> bool:
    """A backend whose every step is an equation of the spec."""
    found = build.spec.component("backend")
    return found.kind == "model" and not found.code and not found.of


Check = Callable[[Evidence, Origin], str | None]


def question(e: Evidence, o: Origin) -> str:
    """ "" where names, units, ranges, period, seed, family, route and level are those that the spec asks for."""
    a, data = o.asked, e.data
    made = json.loads(json.dumps(domain_data(o.domain, o.model)))
    stated = {"relations": [], **data["domain"]}
    made = {k: v for k, v in made.items() if k in stated} if e.older else made
    if made != stated:
        other = next(k for k in {**made, **stated} if made.get(k) != stated.get(k))
        return f"domain: {other} is stated as {stated.get(other)}, and the spec gives {made.get(other)}"
    recording, bare = "recording" in data, "audit" not in data and "recording" not in data
    asked = {"seed": a["seed"]} if not bare else {}
    asked |= {"family": a["family"].name, "route": "calibrate" if recording else "declared" if bare else o.route}
    if other := next((k for k, v in asked.items() if data[k] != v), ""):
        return f"{other} is stated as {data[other]}, and the spec asks for {asked[other]}"
    functions = getattr(a["family"], "functions", None)
    if data["form"]["form"] == "basis" and functions is not None and list(functions) != data["form"]["text"]:
        return f"functions are stated as {data['form']['text']}, and the spec asks for {list(functions)}"
    return "a recording covers nothing" if recording and data.get("cover") is not None else _level(e, o)


def _level(e: Evidence, o: Origin) -> str:
    r, data = o.request, e.data
    if (audit := data.get("audit")) is None:
        # A recording's claim has a confidence where one is written, and none by default.
        written = o.build.spec.config.certificate
        beta = r.beta if written is not None and "confidence" in written.model_fields_set else None
        asked = {"epsilon": r.epsilon, "beta": beta} if "recording" in data else dict.fromkeys(("epsilon", "beta"))
        name = next((k for k, v in asked.items() if data["claim"].get(k) != v), "")
        return name and f"{name} is stated as {data['claim'].get(name)}, and the spec asks for {asked[name]}"
    stated = {
        "violation": (audit["epsilon"], r.epsilon),
        "1 − confidence": (audit["beta"], r.beta),
        "attack": (data.get("attack", {}).get("points", 0), r.attack),
        "exceedances": (data.get("calibration", {}).get("exceedances", r.exceedances), r.exceedances),
        "repeats": (data.get("calibration", {}).get("repeats", r.repeats), r.repeats),
        "symmetries": ((data.get("symmetry") or {}).get("names", []), list(o.asked["symmetries"])),
    }
    if "hidden" in data:
        stated["hidden"] = (data["hidden"]["mode"], o.build.spec.config.hidden.mode)
    if name := next((k for k, (found, asked) in stated.items() if found != asked), ""):
        return f"{name} is stated as {stated[name][0]}, and the spec asks for {stated[name][1]}"
    distribution, refuted = data["claim"].get("distribution", ""), _refuted(data)
    made = Claim.supported(r.claim, data["lipschitz"]["provenance"], refuted, r.epsilon, r.beta, distribution).summary()
    # An empirical claim has no distribution to compare with.
    same = data["claim"] == made or (made["kind"] == "statistical" == data["claim"]["kind"] and "recording" in data)
    return "" if same else f"the claim is stated as {data['claim']}, and {made} follows"


def _refuted(data: Mapping[str, Any]) -> bool:
    looked = [a for a in (data["audit"], data.get("attack", {}), data.get("hidden", {}).get("attack", {})) if a]
    said = any(str(a).startswith("REFUTED") for a in data["assumptions"])
    return said or any(a["violations"] > a.get("allowed", 0) for a in looked)


def constants(e: Evidence, o: Origin) -> str | None:
    """A declared γ, estimator, provenance and safety are the spec's; constants that need no samples are found again."""
    gamma = o.asked["family"].stated(states(e))
    if gamma is not None and not np.array_equal(gamma.arrays()["gamma"], e.arrays["gap.gamma"]):
        return f"γ is stored as {e.arrays['gap.gamma'].tolist()}, and the spec declares another one"
    if (stated := e.data.get("lipschitz")) is None:
        return None if gamma is None else ""
    name, made = _estimator(e, o, stated["method"].partition(" ")[0])
    if stated["method"].partition(" ")[0] != name or stated["provenance"] != made.provenance:
        return f"the constants are stated as {stated['provenance']} by {stated['method']}, and the spec asks for {name}"
    axes = len(o.domain.low) - len((e.data.get("symmetry") or {}).get("axes", ()))
    if (said := getattr(made, "method", None)) is not None and said(axes) != stated["method"]:
        return f"the constants are stated by {stated['method']}, and the spec asks for {said(axes)}"
    if stated["safety"] != getattr(made, "safety", 1.0):
        return f"safety is stated as {stated['safety']}, and the spec asks for {getattr(made, 'safety', 1.0)}"
    if any(s["safety_factor"] != stated["safety"] for s in e.data["states"].values()):
        return "a state has another safety factor than the constants"
    needed = name == "none" or made.provenance == "declared" or (made.provenance == "interval" and o.text)
    return _again(e, o, made) if needed and e.data["predictor"] != "multilinear" else ""


def _estimator(e: Evidence, o: Origin, stated: str) -> tuple[str, Any]:
    """The estimator that the spec asks for, by its name. Without one, it is the route's: none, or Wood and Zhang's; for
    backends with noise, none.
    """
    made = o.asked["lipschitz"]
    if made is not None and registry().build("route", o.route).constants:
        return o.build.spec.config.lipschitz["residual"].kind, made
    none = (
        "recording" in e.data or not registry().build("route", o.route).constants or (o.route, stated) == ("calibrate", "none")
    )
    name = "none" if none else "wood-zhang"
    return name, registry().build("lipschitz", name)


def _again(e: Evidence, o: Origin, estimator: Any) -> str:
    p, domain = predictor(e, o), o.domain
    held = tuple((e.data.get("symmetry") or {}).get("axes", ()))
    backend = o.gate.system if o.whole else o.model
    problem = LipschitzProblem(
        domain, p, e.arrays["resolution"], _unanswered, o.model, backend, o.asked["seed"], rounding=e.rounding, held=held
    )
    found = estimator.bound(problem)
    if held:
        s = e.data["symmetry"]
        found = Symmetry(tuple(s["names"]), held, s["pairs"], tuple(s["deviation"])).applied(found, p, domain)
    arrays = {"lipschitz": found.value} | ({} if found.cells is None else found.cells.arrays())
    arrays |= {} if found.curvature is None or "recording" in e.data else {"curvature": found.curvature}
    for name, value in arrays.items():
        own = e.arrays.get(name)
        if own is None or own.shape != value.shape or not np.allclose(own, value, rtol=_SAME, atol=0.0):
            return f"{name} is another one than {found.method} gives"
    return ""


def _unanswered(name: str, z: Array) -> Array:
    raise UsageError("constants that samples were asked for cannot be found again")


def predictor(e: Evidence, o: Origin) -> Predictor:
    """p, of what is stored of it, or of the extended model that the spec names."""
    kind, nx, nz = e.data["predictor"], o.model.nx, len(e.zone.low)
    if kind == "model":
        return ModelPredictor(o.asked["predictor"], o.model)
    if kind == "affine":
        return AffinePredictor(e.arrays["predictor.offset"], e.arrays["predictor.slope"])
    return AffinePredictor.none(nx, nz)


def resolved(e: Evidence, o: Origin) -> str | None:
    """What r − p is known to: e and that of p; of a recording e is that of a step of f and of what was measured."""
    if e.older or "resolution" not in e.arrays or e.data["predictor"] == "multilinear":
        return None
    own, (z, r) = e.arrays["resolution"], e.samples
    whole = own + predictor(e, o).resolution(o.domain)
    if not np.allclose(e.arrays["remainder.resolution"], whole, rtol=_SAME, atol=0.0):
        return f"e of r − p is stated as {e.arrays['remainder.resolution'].tolist()}, and follows as {whole.tolist()}"
    if "recording" not in e.data:
        return ""
    size = np.abs(z[:, : o.model.nx]).max(axis=0) + np.abs(r).max(axis=0)
    made = o.model.resolution(size) + 4 * np.spacing(size)
    # Of many transitions some are stored, and the others may have been larger.
    most = made if len(z) == e.data["recording"]["transitions"]["fit"] else np.inf
    sure = (own >= made * (1 - _SAME)) & (own <= most * (1 + _SAME))
    return "" if sure.all() else f"e is stated as {own.tolist()}, and follows as {made.tolist()}"


def predicted(e: Evidence, o: Origin) -> str | None:
    """An affine predictor is the one that fits the first samples; stored values are those of the one that is stated."""
    kind = e.data["predictor"]
    if kind not in ("none", "affine", "multilinear", "model"):
        return f"{kind!r} is no predictor"
    if kind == "model" and not isinstance(o.asked["predictor"], Model):
        return "the predictor is stated as a model, and the spec names none"
    family = getattr(o.asked["family"], "predictor", None)
    if family is not None and kind != (asked := _kind(family, o)):
        return f"the predictor is stated as {kind}, and the spec asks for {asked}"
    if kind == "none" and any(np.any(e.arrays.get(f"predictor.{k}", 0.0)) for k in ("offset", "slope")):
        return "a predictor is stored, and none is stated"
    if "remainder.resolution" not in e.arrays:
        return None
    e_p = np.maximum(e.arrays["remainder.resolution"] - e.arrays["resolution"], 0.0)
    points: dict[str, Callable[[], Array]] = {
        "samples": lambda: e.samples[0],
        "audit": lambda: e.audit[0],
        "calibration": lambda: _calibrated(e),
    }
    for name, z in points.items():
        if (stored := e.arrays.get(f"predictor.{name}")) is not None:
            own = predictor(e, o)(z()) if kind == "model" else predicted_by(e, z(), "").mid
            if stored.shape != own.shape or not (np.abs(own - stored) <= 2 * e_p + 4 * np.spacing(np.abs(own))).all():
                return f"predictor.{name} is not what the predictor gives"
    return _affine(e) if kind == "affine" == o.asked["family"].predictor else ""


def _kind(family: Any, o: Origin) -> str:
    """Of the predictor that a family with that option subtracts; what is made of samples is no text."""
    return "model" if isinstance(o.asked["predictor"], Model) else family if isinstance(family, str) else "multilinear"


def _calibrated(e: Evidence) -> Array:
    return e.arrays["held.z"] if "recording" in e.data else e.round(calibrations(e)[0])[0]


def _affine(e: Evidence) -> str:
    z, r = e.round("bound-0") if e.data["digests"] else e.samples
    made, own = AffinePredictor.fit(Samples(z, r)), (e.arrays["predictor.offset"], e.arrays["predictor.slope"])
    near = all(
        np.allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(r).max()) for a, b in zip((made.offset, made.slope), own, strict=True)
    )
    return "" if near else "the affine predictor is another one than fits the first samples"


def stepped(e: Evidence, o: Origin) -> str | None:
    """Every stored residual is that of f̂ and f, to within 2 e, and e that of their arithmetic; both are stepped again."""
    if not o.text or "audit" not in e.data:
        return None
    # What e was taken for before format 2 is less than the arithmetic may err by.
    room = np.maximum(e.rounding, o.residual.resolution(o.domain)) if e.older else e.rounding
    for name, z, r in (*_rounds(e), *_further(e)):
        if text := _apart(o, z, r, 2 * room, name):
            return text
    return "" if e.older else _keyed(e, o)


def arithmetic(e: Evidence, o: Origin) -> str | None:
    """What e is, of f̂ and of f, how it is known, and which terms have most of it; of a backend that is no model nothing is."""
    if "audit" not in e.data:
        return None
    if (stated := e.data.get("arithmetic")) is None:
        return "how e is known is left out"
    seen, nx = stated[0].get("jitter"), o.domain.nx
    if any(sizes is not None and (len(sizes) != nx or min(sizes) < 0) for sizes in (seen, stated[0]["e"])):
        return f"e of f̂ is stated as {stated[0]['e']}, its jitter as {seen}; expected {nx} sizes"
    if o.whole:
        made = [a.to_data() for a in o.residual.arithmetic(o.domain, None if seen is None else np.array(seen))]
    else:
        made = [stated[0], Residual(o.model, o.model).arithmetic(o.domain)[1].to_data()]
        if (stated[0]["proved"] or stated[0]["terms"] != []) and o.build.spec.component("backend").kind != "model":
            return "e of f̂ is stated as proved, or has terms, but f̂ has no equations"
    if not _alike(made, stated):
        return f"e is stated as {stated}, and follows as {made}"
    total = np.array(stated[0]["e"]) + np.array(stated[1]["e"])
    return "" if np.allclose(total, e.rounding, rtol=_SAME, atol=0.0) else "e is not the sum of both"


def _keyed(e: Evidence, o: Origin) -> str:
    """The digests that rounds were sampled under, of model, backend and domain."""
    keys = {own: digest(o.model, r.backend, o.domain) for own, r in ((True, o.audited), (False, o.residual))}
    strange = next((n for n in e.data["digests"] if e.header(n)["key"] != keys[n.startswith(_UNSEEN)]), "")
    # Another version may have other digests of the same.
    told = strange and e.data["versions"]["gapcert"] == __version__
    return f"round {strange} was sampled of another model, backend or domain" if told else ""


_UNSEEN = ("audit-", "calibration-")
"""Rounds of points that no fit has seen."""


def _rounds(e: Evidence) -> Iterator[tuple[str, Array, Array]]:
    yield "samples", *e.samples
    yield "audit", *e.audit


def _further(e: Evidence) -> Iterator[tuple[str, Array, Array]]:
    """What constants were made of: points and residuals; pairs under a common hidden state are none."""
    for name in e.data["digests"]:
        if not name.startswith(("bound-", "audit-")) and (e.folder / "samples" / name / "points.npy").exists():
            z, r = e.round(name)
            if z.shape[1] == len(e.zone.low):
                yield name, z, r


def _apart(o: Origin, z: Array, r: Array, e: Array, name: str) -> str:
    own = o.audited if name.startswith(("audit", *_UNSEEN)) else o.residual
    for a in range(0, len(z), 100_000):
        rows = slice(a, a + 100_000)
        apart = np.abs(difference(o.model.states, own(z[rows]), r[rows]))
        if (over := (apart > e).any(axis=1)).any():
            k = int(np.argmax(over))
            return f"the residual at {z[rows][k].tolist()} of the {name} is stated as {r[rows][k].tolist()}, and is another one"
    return ""


def gates(e: Evidence, o: Origin) -> str | None:
    """What is said of hidden state and of inputs that do not arrive is what f and f̂ show when they are asked again."""
    if not o.whole or "audit" not in e.data:
        return None
    hidden = json.loads(json.dumps({k: v for k, v in o.gate.summary().items() if k != "attack"}))
    stated = {k: v for k, v in e.data.get("hidden", {}).items() if k != "attack"}
    if not _alike(hidden, stated):
        return f"hidden state is stated as {stated}, and was found to be {hidden}"
    turns = list(repeating(o.model, o.asked["backend"], o.domain, o.asked["seed"]))
    if turns != [a for a in e.data["assumptions"] if " closes on itself (" in a]:
        return f"of angles that close on themselves follows {turns}, and something else is stated"
    said = responses(o.residual, o.domain, o.asked["seed"])
    stated_warnings = [w for w in e.data.get("warnings", []) if " of f̂ " in w and not w.startswith("The slope")]
    return "" if said == stated_warnings else f"inputs are said to answer as {stated_warnings}, and answer as {said}"


def shifted(e: Evidence, o: Origin) -> str | None:
    """A declared symmetry is proved where the equations of both prove it, and there alone."""
    if not (s := e.data.get("symmetry")):
        return None
    if not o.whole:
        model = o.build.spec.config.backend is not None and o.build.spec.component("backend").kind == "model"
        return "the symmetry is said to be proved, and f̂ is no text" if s.get("proved") and not model else ""
    none = AffinePredictor.none(o.model.nx, len(e.zone.low))
    backend, seed = o.gate.system, o.asked["seed"]
    asked = LipschitzProblem(
        o.domain, none, e.arrays["resolution"], lambda _, z: o.residual(z), o.model, backend, seed, rounding=e.rounding
    )
    found = symmetric(asked, Symmetry(tuple(s["names"]), tuple(s["axes"]), s["pairs"], tuple(s["deviation"])))
    return "" if found.proved == s.get("proved", False) else f"the symmetry is {'' if found.proved else 'not '}proved"


def _alike(a: Any, b: Any) -> bool:
    """The same data, numbers to within rounding."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_alike(a[k], b[k]) for k in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= _SAME * max(abs(a), abs(b)) + 1e-15
    return bool(a == b)


def strength(e: Evidence, o: Origin) -> str | None:
    """Where γ exceeds half of what inputs can do, and whether nothing would move as well, as the model says."""
    if "recording" in e.data:
        (z, r), (low, high) = (e.arrays[f"held.{n}"] for n in "zr"), bounds(e, e.arrays["held.z"], "predictor.calibration")
    elif "audit" not in e.data or "digests" not in e.data:
        return None
    else:
        (z, r), (low, high) = e.audit, e.audited
    gamma = np.maximum(np.abs(low.lo), np.abs(high.hi))
    x, u = o.domain.split(z)
    still = np.abs(difference(o.model.states, o.model.step(x, u).x, x) + r).mean(axis=0)
    power = overpowered(gamma, o.model, o.domain, z)
    for i, name in enumerate(states(e)):
        s = e.data["states"][name]
        stated = s.get("overpowered")
        if (stated is None) != (power[i] is None) or abs((stated or 0.0) - (power[i] or 0.0)) > 2 / len(z):
            return f"overpowered of {name} is stated as {stated}, and follows as {power[i]}"
        mean, bound = s["gamma_mean"], s["constant_bound"]
        sure = mean > bound * (1 + 2e-9) or mean > still[i] * (1 + _SAME)
        possible = mean > bound * (1 + 5e-10) or mean >= still[i] * (1 - _SAME)
        if s["vacuous"] != (s["resolved"] and sure) and s["vacuous"] != (s["resolved"] and possible):
            return f"vacuous of {name} is stated as {s['vacuous']}; mean γ {mean:.6g}, standing still {still[i]:.6g}"
    return ""


def attacked(e: Evidence, o: Origin, most: int = 100_000) -> str | None:
    """The further points that the audit's entry draws, as far as the first `most`, stepped and judged again."""
    if not o.text or not (stated := e.data.get("attack")):
        return None
    n = stated["points"]
    z = o.domain.draw(min(n, most), draws(e, "attack"))
    r, zero = o.audited(z), np.zeros(2, dtype=np.int64)
    certain, possible = zero.copy(), zero.copy()
    for a in range(0, len(z), 10_000):
        found = _violations(e, o, z[a : a + 10_000], r[a : a + 10_000])
        certain, possible = certain + found[0], possible + found[1]
    counts = np.array([stated["violations"], stated["gamma_violations"]])
    left = n - len(z)
    if (counts < certain).any() or (counts > possible + left).any():
        return f"{counts.tolist()} points of {n} are said to lie outside and above γ; {certain.tolist()} of {len(z)} do"
    return ""


def _violations(e: Evidence, o: Origin, z: Array, r: Array) -> tuple[Any, Any]:
    """How many leave [l, u], and exceed γ, for certain and possibly."""
    own = replace(e, arrays={**e.arrays, "predictor.attack": predictor(e, o)(z)}) if e.data["predictor"] == "model" else e
    low, high = bounds(own, z, "predictor.attack")
    slack = 64 * np.spacing(np.maximum(np.abs(low.lo), np.abs(high.hi))) + 2 * e.rounding
    gamma = np.maximum(np.abs(low.lo), np.abs(high.hi))
    sure = [(r < low.lo - slack) | (r > high.hi + slack), np.abs(r) > gamma + slack]
    may = [(r < low.hi + slack) | (r > high.lo - slack), np.abs(r) > gamma - 2 * slack]
    counts = [np.array([rows.any(axis=1).sum() for rows in both]) for both in (sure, may)]
    return counts[0], counts[1]


def again(e: Evidence, o: Origin, n: int) -> tuple[str, str]:
    """n stored transitions, evenly chosen, stepped by f̂ and f once more: how they agree, and "" where they do within 2 e."""
    rounds = list(_rounds(e))
    total = sum(len(z) for _, z, _ in rounds)
    pick = np.unique(np.linspace(0, total - 1, min(n, total)).astype(int))
    first, same, text = 0, True, ""
    for name, z, r in rounds:
        rows = pick[(pick >= first) & (pick < first + len(z))] - first
        own, first = o.audited if name == "audit" else o.residual, first + len(z)
        same = same and np.array_equal(own(z[rows]), r[rows])
        text = text or _apart(o, z[rows], r[rows], 2 * e.rounding, name)
    how = "are the same bit for bit" if same else "agree within e, not bit for bit"
    return f"{len(pick)} stored transitions, stepped again, {how}", text or _keyed(e, o)


CHECKS: tuple[tuple[str, Check], ...] = (
    ("names, ranges and level are those that the spec asks for", question),
    ("constants come from what the spec asks for", constants),
    ("the predictor is the one that the spec asks for", predicted),
    ("r and r − p are known as closely as f, p and what was measured allow", resolved),
    ("e of f and f̂ is known as it is said to be", arithmetic),
    ("residuals and e are those of the spec's f and f̂, stepped again", stepped),
    ("hidden state and inputs do what is said of them", gates),
    ("the declared symmetry is proved where it is said to be", shifted),
    ("what γ leaves to the inputs is as the model says", strength),
    ("the attack's points are judged as stated", attacked),
)
