"""What a question was called before modules moved: `python tests/identity/write.py tests/identity/written.zip`, run at fae8e6d.

It writes `digests.json` (of the systems below, and of what every shipped spec asks about), `classes.json` (where each class
was), `outside/` (the certificate of a third party's backend, its samples and the ledger), and `cells/` and `predictive/` (a
spec's run with a controller that is saved on cells, or keeps a gap function as data), with what the controllers answer.
"""

import importlib
import json
import pkgutil
import shutil
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import numpy as np
import outsider

import gapcert as gc

ROOT = Path(__file__).parents[2]
more = getattr(gc, "plugin", gc)  # there was one table of names at fae8e6d


def systems() -> dict[str, gc.System]:
    """A third party's, and what it may hold."""
    domain = outsider.domain()
    return {
        "alone": outsider.Outsider(0.01),
        "with a domain": outsider.Outsider(0.01, domain, more.Cover(domain, (3, 4)), more.Points(np.eye(2))),
        "with classes and functions": outsider.Outsider(0.01, gc.StateSpec, gc.Domain, more.difference, gc.certify, len),
        "with parts": outsider.Outsider(0.01, gc.Interval(np.zeros(2), np.ones(2)), gc.Claim("empirical"), gc.Request()),
        "with another": outsider.Outsider(0.01, outsider.Outsider(0.02, {"of": domain, "set": frozenset("ab")})),
    }


def questions() -> dict[str, dict[str, str]]:
    """Of shipped specs, where their engines are installed: digests of the spec, the model and the backend."""
    found = {}
    for path in sorted(ROOT.glob("specs/**/*.yaml")):
        name = str(path.relative_to(ROOT))
        try:
            spec = gc.load_spec(path)
            model = spec.build("model", allow_code=True, period=0.01)  # s, where a recording is to say
            built = {"model": model.digest()}
            if spec.data.get("backend") is not None:
                built["backend"] = spec.build("backend", model=model, allow_code=True).digest()
        except gc.GapcertError as error:
            print(name, "-", str(error)[:150], file=sys.stderr)
            continue
        found[name] = {"spec": spec.digest} | built
    return found


def classes() -> dict[str, list[str]]:
    """Module → the classes that it defines."""
    found = {}
    for top in ("gapcert", *sorted(p.name for p in (ROOT / "plugins").iterdir() if (p / "__init__.py").exists())):
        for module in pkgutil.walk_packages(importlib.import_module(top).__path__, f"{top}."):
            if not module.name.endswith("__main__"):
                names = vars(importlib.import_module(module.name)).items()
                own = sorted(n for n, v in names if isinstance(v, type) and v.__module__ == module.name)
                found |= {module.name: own} if own else {}
    return found


def certificate(folder: Path, seed: int = 0) -> gc.Certificate:
    """Of a third party's backend, with samples and ledger; the same question again is the same audit."""
    known, constants = gc.registry(), {"x": {"x": 0.03, "u": 0.0}}
    declared = known.config("lipschitz", "declared").model_validate({"kind": "declared", "values": constants})
    return gc.certify(
        outsider.model(),
        outsider.Outsider(0.01),
        outsider.domain(),
        sampling=gc.AdaptiveSampling(budget=60),
        lipschitz=known.build("lipschitz", "declared", declared, gc.Context(model=outsider.model())),
        predictor="none",  # a fit is not the same to the last bit on every machine, nor then are ties between segments
        request=gc.Request("statistical", epsilon=0.05, beta=0.01),
        seed=seed,
        folder=folder,
        executor=lambda: ThreadPoolExecutor(1),
    )


PART = {
    "version": 1,
    "domain": {"x": [-1, 1], "u": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 60, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope", "predictor": "none"},
    "certificate": {"claim": "statistical", "violation": 0.05, "confidence": 0.99},
    "report": {"html": False, "rerun": False},
    "closed_loop": {"steps": 10, "starts": 5},
}
TEXT = "0.5*x + c*u"
APART = "abs(x)/64"  # as all else here it is exact, fused or not: no machine has other samples, nor another audit
SPECS = {
    "cells": {
        **PART,
        "model": outsider.LINE,
        "backend": {**outsider.LINE, "next": {"x": f"0.5*x + u + {APART}"}},
        "controller": {
            "kind": "symbolic",
            "goal": {"invariance": {"x": [-0.5, 0.5]}},
            "cells": {"x": 20},
            "inputs": {"u": 9},
        },
    },
    "predictive": {
        **PART,
        "model": {**outsider.LINE, "parameters": {"c": "1"}, "next": {"x": TEXT}},
        "backend": {**outsider.LINE, "parameters": {"c": "1"}, "next": {"x": f"{TEXT} + {APART}"}},
        "controller": {"kind": "mpc", "goal": {"invariance": {"x": [-0.5, 0.5]}}, "horizon": 4, "adapt": {"c": ["0.9", "1.1"]}},
    },
}


def answers(controller: gc.Controller) -> dict[str, list[float]]:
    """At states of its domain: these, and the inputs there."""
    x = np.linspace(-0.5, 0.5, 21)[:, None]
    x = x[controller.contains(x)]
    return {"x": x[:, 0].tolist(), "u": controller.act(x, "first")[:, 0].tolist()}


def write(folder: Path) -> None:
    digests = {"systems": {n: s.digest() for n, s in systems().items()}, "questions": questions()}
    (folder / "digests.json").write_text(json.dumps(digests, indent=1))
    (folder / "classes.json").write_text(json.dumps(classes(), indent=0))
    certificate(folder / "outside" / "run").save(folder / "outside" / "run")
    for name, spec in SPECS.items():
        (folder / f"{name}.yaml").write_text(json.dumps({"name": name, **spec}, indent=1))
        run = gc.run(folder / f"{name}.yaml", out=folder / name)
        found = answers(gc.load_controller(run.folder / "controller" / "with_gamma"))
        (folder / name / "answers.json").write_text(json.dumps(found))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        shutil.make_archive(sys.argv[1].removesuffix(".zip"), "zip", folder)
