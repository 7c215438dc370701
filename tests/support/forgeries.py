"""Run folders forged at random, as a clever forger would: anything changed, and every digest above it made anew.

A forgery changes one thing that a reader or a check may look at: a field of a JSON object, an entry of an array, a sentence,
a whole file. What the folder's own files say of each other is then mended from the bottom up: shards in their manifests, rounds
and arrays in the certificate, that in controllers and summary, the spec in run.json, the page, the root.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.plugin import GapcertError, beside_nominal, load_spec, registry
from gapcert.run.folder import sealed
from gapcert_cells import load_controller
from gapcert_verify import sentences, verify_run
from gapcert_verify.evidence import load

OWN = {"format", "form", "predictor", "domain", "arrays", "versions", "symmetry", "cover", "seed", "digests", "arithmetic"}
"""What a certificate stores beside its summary."""

TRUSTED = {
    r"certificate\.json:versions\..*": "Versions, times",
    r"spec\.json:sampling\..*|spec\.json:lipschitz\.residual\.(budget|boxes|pairs|distance|cells)": "budgets of the spec",
    r"spec\.json:(closed_loop|report|expect)\..*": "budgets of the spec",
    r"spec\.json:controller\.(horizon|weights|reference|policy|refine).*": "budgets of the spec",
    r"spec\.json:seed": "seed and budgets of the spec",
    r"spec\.json:(model|backend)\..*": "residuals are those of (it and of )?f|γ is what a person declares",
    r"summary\.json:timings\..*": "Versions, times",
    r"figures\.json:lanes\.\d+\.at\..*": "Versions, times",
    r"controller/with_gamma/controller\.json:evidence\.(levels|rounds|reason|change|gap_over_cells).*": "rounds its games took",
    r"controller/without_gamma/.*|figures\.(json|npz):/?winning.*": "controller without γ promises nothing",
    r"progress\.jsonl.*|run\.json:(executor|folder)": "Versions, times",
    r"summary\.json:run_dir": "Versions, times",
    r"summary\.json:closed_loop\..*|closed_loop\.npz:.*|figures\.(json|npz):/?loop.*": "closed loop",
    r"figures\.(json|npz):.*residual.*|figures\.npz:/gap/slices/\d+/gap": "What only f̂ can tell",
    r"certificate\.json:(hidden|attack)\..*": "What only f̂ can tell",
    r"certificate\.json:arithmetic\.0\.jitter.*": "What only f̂ can tell.* how it rounds",
    r"samples/.*": "constants|What only f̂ can tell|stored transitions|order is trusted",
    r"certificate\.npz:(lipschitz|curvature.*|cells.*)": "constants",
    r"certificate\.json:warnings.*": "warned of slopes",
    r"certificate\.json:recording\.book\.question": "number of the calibration",
    r"figures\.json:recorded\.at": "stored transitions",
    r"certificate\.json:recording\.(trajectories|transitions\.fit)": "numbers of trajectories and of fitted transitions",
    r"controller/.*:evidence\.(tube|reference|terminal_margin|domain_fraction)\b.*": "figures of the reference",
    r"controller/.*:evidence\.solver\b.*": "how solvers were tuned",
    r"certificate\.npz:(held|fit)\..*|certificate\.json:recording\.rows\..*": "stored transitions",
    r"spec\.json:recording\..*|figures\.npz:/recorded/.*/t": "stored transitions",
}
"""Of which subjects (as patterns of `Forgery.subject`) a sentence of `trusted` speaks, as a pattern of that sentence."""

SAME = [
    ("spec.json:gap.predictor", "affine", "(left out)"),
    ("spec.json:certificate.route", "calibrate", "(left out)"),
    ("controller/with_gamma/controller.json:format", 1, "(left out)"),
]
"""Forgeries that change nothing: what is left out is meant without it, too."""


@dataclass(frozen=True)
class Forgery:
    """What was changed, `file:path`, from what to what."""

    subject: str
    was: Any = None
    now: Any = None

    def answered(self, run: Path) -> str:
        """ "" where `verify` catches it, or says that its subject is trusted; else what is wrong."""
        if self.was == self.now or (self.subject, self.was, self.now) in SAME:
            return ""
        try:
            found = verify_run(run)
        except GapcertError:
            return ""
        except Exception as error:  # a traceback is no answer
            return repr(error)
        if found["verdict"] == "fails":
            return ""
        phrases = [phrase for pattern, phrase in TRUSTED.items() if re.fullmatch(pattern, self.subject)]
        if isinstance(self.was, str) and self.was.startswith("f̂ is a function of its arguments alone"):
            phrases.append("How f̂ answered|What only f̂ can tell")
        told = any(re.search(phrase, sentence) for phrase in phrases for sentence in found["trusted"])
        return "" if told else f"{self.subject}: {self.was!r} → {self.now!r} was accepted; trusted: {found['trusted']}"


@dataclass
class Forger:
    """Draws forgeries of copies of run folders. rng: what draws them."""

    rng: np.random.Generator
    seen: set[str] = field(default_factory=set)

    def forge(self, source: Path, target: Path) -> Forgery:
        """A copy of a run with one thing changed, and all digests mended; what was changed."""
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
        while True:
            made = self._changed(target)
            if made is not None and made.was != made.now:
                break
        self.mend(target, made)
        return made

    def _changed(self, run: Path) -> Forgery | None:
        kinds: list[tuple[float, Callable[[Path], Forgery | None]]] = [
            (6, lambda r: self._json(r, "certificate.json")),
            (3, self._sentence),
            (4, lambda r: self._npz(r, "certificate.npz")),
            (3, self._shard),
            (4, lambda r: self._json(r, "summary.json")),
            (2, lambda r: self._json(r, "spec.json")),
            (1, lambda r: self._json(r, "figures.json")),
            (2, lambda r: self._npz(r, "figures.npz")),
            (2, self._controller),
            (1, self._swap),
            (1, self._file),
            (1, self._page),
            (1, lambda r: self._npz(r, "closed_loop.npz")),
        ]
        weights = np.array([w for w, _ in kinds])
        return kinds[int(self.rng.choice(len(kinds), p=weights / weights.sum()))][1](run)

    def _json(self, run: Path, name: str) -> Forgery | None:
        """One leaf of a JSON file, or a key left out."""
        if not (path := run / name).exists():
            return None
        data = json.loads(path.read_text())
        nodes = [(at, v) for at, v in leaves(data) if not _mended(name, at)]
        at, was = nodes[int(self.rng.integers(len(nodes)))]
        if (drawn := self.rng.random()) < 0.15:
            return _put(run, name, at, was, _GONE)
        if drawn < 0.25 and name != "spec.json" and _guarded(data, at[:-1]):
            return _put(run, name, (*at[:-1], "reviewed"), _GONE, "by everyone")
        return _put(run, name, at, was, self.other(was))

    def other(self, value: Any) -> Any:
        """Another value that may pass for this one."""
        found = others(value)
        return found[int(self.rng.integers(len(found)))]

    def every(self, source: Path, target: Path) -> Iterator[Callable[[], Forgery]]:
        """Each field of each JSON file with every other value, and left out; each array changed four times. A forgery is made
        when it is called. Of the entries of a list the first and the last stand for all.
        """

        def copied(change: Callable[[Path], Forgery]) -> Forgery:
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(source, target)
            made = change(target)
            self.mend(target, made)
            return made

        json_files = ["certificate.json", "summary.json", "spec.json", "figures.json"]
        for path in [*(source / n for n in json_files), *sorted((source / "controller").glob("with_gamma/*.json"))]:
            name = path.relative_to(source).as_posix()
            data = json.loads(path.read_text()) if path.exists() else {}
            ends: dict[tuple[Any, ...], list[tuple[tuple[Any, ...], Any]]] = {}
            for at, was in leaves(data):
                if at and not _mended(name, at):
                    ends.setdefault(tuple(k for k in at if not isinstance(k, int)), []).append((at, was))
            for found in ends.values():
                for at, was in {str(at): (at, was) for at, was in (found[0], found[-1])}.values():
                    for now in (_GONE, *others(was)):
                        yield partial(copied, partial(_put, name=name, at=at, was=was, now=now))
        for path in [*source.glob("*.npz"), *sorted((source / "controller").glob("with_gamma/*.npz"))]:
            name = path.relative_to(source).as_posix()
            with np.load(path, allow_pickle=False) as stored:
                keys = [k for k in sorted(stored) if stored[k].size and stored[k].dtype.kind in "fiub"]
            for key in keys:
                for _ in range(4):
                    yield partial(copied, partial(self._moved, name=name, key=key))

    def _sentence(self, run: Path) -> Forgery:
        """A sentence of a certificate left out, invented, or with another word."""
        data, key = json.loads((run / "certificate.json").read_text()), str(self.rng.choice(["assumptions", "warnings"]))
        was = list(data.get(key, []))
        k, now = int(self.rng.integers(len(was) + 1)), list(was)
        invented = "This was proved for every machine, everywhere and for ever."
        how = self.rng.choice(["out", "in", "word", "none"])
        if how == "in" or not was:
            now.insert(k, invented)
        elif how == "out":
            del now[min(k, len(was) - 1)]
        elif how == "word":
            words = now[min(k, len(was) - 1)].split(" ")
            del words[int(self.rng.integers(len(words)))]
            now[min(k, len(was) - 1)] = " ".join(words)
        else:
            now = []
        data[key] = now
        (run / "certificate.json").write_text(json.dumps(data))
        return Forgery(f"certificate.json:{key}", was, now)

    def _npz(self, run: Path, name: str) -> Forgery | None:
        """An array of an .npz, scaled, or one entry of it moved."""
        if not (path := run / name).exists():
            return None
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        keys = [k for k in sorted(arrays) if arrays[k].size and arrays[k].dtype.kind in "fiub"]
        if not keys:
            return None
        return self._moved(run, name, keys[int(self.rng.integers(len(keys)))])

    def _moved(self, run: Path, name: str, key: str) -> Forgery:
        path = run / name
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        was = arrays[key]
        arrays[key] = self.moved(was)
        np.savez(path, **arrays)
        same = np.array_equal(was, arrays[key], equal_nan=was.dtype.kind == "f")
        if name == "figures.npz" and was.dtype.kind == "f":  # no picture shows what is within the rounding of its numbers
            same = np.allclose(was, arrays[key], rtol=0.0, atol=1e-14, equal_nan=True)
        return Forgery(f"{name}:{key}", 0, 0 if same else 1)

    def moved(self, array: Any) -> Any:
        now = np.array(array)
        if array.dtype.kind == "b":
            return ~now
        if self.rng.random() < 0.5:
            return (now * self.rng.choice([0, 2])).astype(array.dtype)
        k = np.unravel_index(int(self.rng.integers(array.size)), array.shape)
        now[k] = now[k] * 2 + 1 if array.dtype.kind != "u" else now[k] ^ 1
        return now

    def _shard(self, run: Path) -> Forgery | None:
        """Residuals or points of a round."""
        if not (rounds := sorted((run / "samples").glob("*/*.npy"))):
            return None
        path = rounds[int(self.rng.integers(len(rounds)))]
        was = np.load(path)
        if was.dtype.names:
            now = was.copy()
            now["r"] *= 0.5
        else:
            now = self.moved(was)
        np.save(path, now)
        return Forgery(f"samples/{path.parent.name}/{path.name}", 0, 0 if was.tobytes() == now.tobytes() else 1)

    def _controller(self, run: Path) -> Forgery | None:
        found = sorted((run / "controller").glob("*/*.np[yz]")) + sorted((run / "controller").glob("*/*.json"))
        if not found:
            return None
        path = found[int(self.rng.integers(len(found)))]
        name = path.relative_to(run).as_posix()
        return self._json(run, name) if path.suffix == ".json" else self._npz(run, name)

    def _swap(self, run: Path) -> Forgery:
        """Two states of the same kind change names."""
        data = json.loads((run / "certificate.json").read_text())
        axes, was = data["domain"]["axes"], list(data["domain"]["axes"])
        axes[0], axes[1] = axes[1], axes[0]
        if data["domain"]["states"] > 1:
            states = data["states"]
            states[axes[0]], states[axes[1]] = states[axes[1]], states[axes[0]]
        (run / "certificate.json").write_text(json.dumps(data))
        return Forgery("certificate.json:domain.axes", was, axes)

    def _file(self, run: Path) -> Forgery | None:
        """A file left out."""
        files = [p for p in sorted(run.iterdir()) if p.is_file() and p.name not in _FREE]
        path = files[int(self.rng.integers(len(files)))]
        path.unlink()
        return Forgery(path.name, 1, 0)

    def _page(self, run: Path) -> Forgery | None:
        if not (path := run / "report.html").exists():
            return None
        text = path.read_text()
        path.write_text(text.replace("Holds", "Holds for ever", 1))
        return Forgery("report.html", text.count("Holds"), text.count("Holds for ever"))

    # What a clever forger mends

    def mend(self, run: Path, made: Forgery) -> None:
        """Every digest above what was changed; what cannot be made of a folder so changed stays."""
        steps: list[Callable[[Path], Any]] = [self._rounds, lambda r: self._certificate(r, made), self._spec]
        if made.subject != "report.html" and (run / "report.html").exists():
            steps.append(registry().get("report", "html").load())
        if (run / "root.json").exists():
            steps.append(lambda r: (r / "root.json").write_text(json.dumps(sealed(r))))
        for step in steps:
            with contextlib.suppress(Exception):
                step(run)

    def _rounds(self, run: Path) -> None:
        data = json.loads((run / "certificate.json").read_text())
        for name in data.get("digests", {}):
            folder = run / "samples" / name
            header, *lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
            for line in lines:
                line["sha256"] = _sha256(folder / f"chunk-{line['chunk']:06d}.npy")
            if (points := folder / "points.npy").exists():
                z = np.load(points)
                header["points"] = hashlib.sha256(np.ascontiguousarray(z).tobytes() + str(z.shape).encode()).hexdigest()
            (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (header, *lines)))
            lines.sort(key=lambda line: line["chunk"])
            parts = [[line[k] for k in ("sha256", "residuals") if k in line] for line in lines]
            entries = parts if "extremes" in header else [digest for (digest,) in parts]
            data["digests"][name] = hashlib.sha256(json.dumps([header, entries]).encode()).hexdigest()
        (run / "certificate.json").write_text(json.dumps(data))

    def _certificate(self, run: Path, made: Forgery) -> None:
        """Sentences that follow the data, the digest of the arrays, and the copies in summary and controllers."""
        data = json.loads((run / "certificate.json").read_text())
        data["arrays"] = _sha256(run / "certificate.npz")
        (run / "certificate.json").write_text(json.dumps(data))
        if "assumptions" not in made.subject and self.rng.random() < 0.5:
            rows = [said for row in sentences.ASSUMPTIONS for said in row(load(run))]
            if len(rows) == len(data["assumptions"]):
                pairs = zip(rows, data["assumptions"], strict=True)
                data["assumptions"] = [said if isinstance(said, str) else old for said, old in pairs]
                (run / "certificate.json").write_text(json.dumps(data))
        for path in (run / "controller").glob("*/controller.json"):
            saved = json.loads(path.read_text())
            if "certificate" in saved.get("evidence", {}) and "evidence.certificate" not in made.subject:
                saved["evidence"]["certificate"] = _sha256(run / "certificate.json")
                path.write_text(json.dumps(saved))
        if (run / "summary.json").exists() and not made.subject.startswith("summary.json:certificate"):
            told = json.loads((run / "summary.json").read_text())
            told["certificate"] = {k: v for k, v in data.items() if k not in OWN}
            (run / "summary.json").write_text(json.dumps(told))
        if not made.subject.startswith("summary.json:controller"):
            self._controllers(run)

    def _controllers(self, run: Path) -> None:
        """The summary's row says what the saved controllers do."""
        told = json.loads((run / "summary.json").read_text())
        if told.get("controller"):
            careful, trusting = (load_controller(run / "controller" / n).facts() for n in ("with_gamma", "without_gamma"))
            told["controller"].update(json.loads(json.dumps({**careful, **beside_nominal(careful, trusting)}, default=str)))
            (run / "summary.json").write_text(json.dumps(told))

    def _spec(self, run: Path) -> None:
        """run.json knows the spec as it is now."""
        if not (run / "spec.json").exists():
            return
        mark = json.loads((run / "run.json").read_text())
        mark["spec"] = load_spec(json.loads((run / "spec.json").read_text()), folder=Path(mark["folder"])).digest
        (run / "run.json").write_text(json.dumps(mark))
        told = json.loads((run / "summary.json").read_text())
        told["run_dir"] = f"runs/{mark['name']}-{mark['spec'][:8]}"
        (run / "summary.json").write_text(json.dumps(told))


_GONE = "(left out)"
_FREE = ("run.lock", "progress.jsonl", "run.rrd", "report.html")


def _mended(name: str, at: tuple[Any, ...]) -> bool:
    """Is it a digest, which is mended anyway?"""
    if name == "certificate.json":
        return at[0] in ("digests", "arrays")
    return name.endswith("controller.json") and at[-1] == "certificate"


def leaves(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """(path, value) of all that nested objects and lists hold, these themselves where they are empty."""
    items = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else ()
    inner = [part for key, value in items for part in leaves(value, (*at, key))]
    yield from inner or [(at, copy.deepcopy(node))]


def others(value: Any) -> list[Any]:
    """Other values that may pass for this one."""
    if isinstance(value, bool):
        found: list[Any] = [not value]
    elif isinstance(value, int):
        found = [value + 1, max(0, value - 1), 10 * value, 0]
    elif isinstance(value, float):
        found = [value * share + (value == 0) * 0.25 for share in (0.0, 0.5, 0.9, 1.1, 3.0, -1.0)]
    elif isinstance(value, str):
        number = re.search(r"\d+(?:\.\d+)?", value)
        found = [value[: number.start()] + f"{float(number[0]) * 2 + 1:g}" + value[number.end() :]] if number else []
        found += [f"{value} and beyond", "interval", "deterministic", value[: len(value) // 2]]
    elif isinstance(value, list):
        found = [value[:-1] if value else ["nothing"]]
    else:
        found = [{} if value else {"nothing": 0}]
    return [v for k, v in enumerate(found) if v not in [value, *found[:k]]]


def _put(run: Path, name: str, at: tuple[Any, ...], was: Any, now: Any) -> Forgery:
    """A field of a JSON file becomes another one, or is left out."""
    data = json.loads((run / name).read_text())
    if now == _GONE:
        remove(data, at)
    else:
        put(data, at, now)
    (run / name).write_text(json.dumps(data))
    return Forgery(f"{name}:{'.'.join(map(str, at))}", was, now)


def put(node: Any, at: tuple[Any, ...], value: Any) -> None:
    for key in at[:-1]:
        node = node[key]
    node[at[-1]] = value


def _guarded(node: Any, at: tuple[Any, ...]) -> bool:
    """Is it an object whose fields are known, rather than names?"""
    for key in at:
        node = node[key]
    named = {"controller", "evidence", "goal", "form", "versions", "timings", "digests", "files", "beside", "spread", "at"}
    return isinstance(node, dict) and not named & set(at)


def remove(node: Any, at: tuple[Any, ...]) -> None:
    for key in at[:-1]:
        node = node[key]
    del node[at[-1]]


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
