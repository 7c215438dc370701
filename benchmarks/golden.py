"""Are the answers still the same? What a checkout answers to each question below, and where another one answers otherwise.

    golden.py record FOLDER [--checkout PATH] [--only TEXT]     one file per question; what is there already is not asked again
    golden.py compare BEFORE AFTER [--within 1e-12]             exit 1 where they differ
    golden.py store                                             the short answers that the tests hold every commit to

Questions are all specs in specs/ and a quick exam (benchmarks/exams), in which an effect is hidden in each recording. Each is
asked in a process of its own, with one thread. Words, counts and digests must be equal and numbers within a relative tolerance;
how long something took, and where, is left out. An audit's points hang on every bit of what is audited, so on the processor:
where another function was audited, words are compared and numbers are not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SEED = 2026
PATIENCE = 1e6
"""Seconds that an exam may take."""
LEFT_OUT = re.compile(r"seconds|timings|versions|cpu|_ms$|report")
"""Keys of what no two runs have in common."""
STORED = ROOT / "tests" / "data" / "golden.json"
SHORT = (
    *(f"specs/{name}.yaml" for name in ("free_fall", "bounce", "pendulum_drake", "pendulum_gymnasium", "pendulum_adaptive")),
    *(f"specs/{name}.yaml" for name in ("pendulum", "benchmarks/dcdc", "benchmarks/aircraft_coarse", "diagnose/pendulum")),
    *("faint 0", "nothing 0", "singles 0", "engines 0"),
)
"""Questions of every kind that take some seconds each: routes, engines, symbolic and predictive controllers, diagnoses."""
ONE = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")}


def questions(checkout: Path) -> list[str]:
    code = (
        "from exams.parts import PARTS; print(*(f'{name} {k}' for name, p in PARTS.items() for k in range(p.quick)), sep='\\n')"
    )
    exam = _python(checkout, "-c", code, text=True, check=True).stdout.splitlines()
    return [str(path.relative_to(checkout)) for path in sorted(checkout.glob("specs/**/*.yaml"))] + exam


def _python(checkout: Path, *arguments: object, **options: Any) -> subprocess.CompletedProcess[Any]:
    """With the packages and the exam of a checkout."""
    paths = [str(checkout / part) for part in ("core", "plugins", "benchmarks")]
    env = os.environ | ONE | {"PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run([sys.executable, *map(str, arguments)], cwd=checkout, env=env, capture_output=True, **options)


def ask(question: str) -> Any:
    if not question.endswith(".yaml"):
        from exams.parts import PARTS

        part, index = question.split()
        return PARTS[part].ask(SEED, int(index), PATIENCE)
    import gapcert as gc

    with tempfile.TemporaryDirectory() as folder:
        try:
            run = gc.run(question, overrides=("report.html=false", "report.rerun=false"), out=folder, allow_code=True)
        except gc.GapcertError as error:
            return {"error": str(error)}
        said = {"summary": run.summary, "files": {k: v for made in (run, *run.runs) for k, v in _files(made.folder)}}
        return json.loads(json.dumps(said, default=str).replace(folder, "OUT"))


def _files(folder: Path) -> Iterator[tuple[str, Any]]:
    """Arrays of a run, each by its shape, its mean and that of its squares; of samples the digests."""
    import numpy as np

    for path in sorted(folder.rglob("*.npz")):
        with np.load(path) as arrays:
            for name in arrays.files:
                a = arrays[name]
                means = [float(np.mean(b)) for b in (a, a * a)] if a.size and a.dtype.kind in "biuf" else []
                yield f"{folder.name}/{path.relative_to(folder)}/{name}", [list(a.shape), means]
    for path in sorted(folder.glob("samples/*/manifest.jsonl")):
        yield f"{folder.name}/{path.relative_to(folder)}", sorted(path.read_text().splitlines())


def record(folder: Path, checkout: Path, only: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    asked = [q for q in questions(checkout) if only in q]
    for k, question in enumerate(asked, 1):
        target = folder / f"{re.sub(r'[^a-z0-9_]+', '-', question)}.json"
        if not target.exists():
            done = _python(checkout, Path(__file__).resolve(), "ask", question)
            answer = (
                done.stdout or json.dumps({"question": question, "answer": {"error": done.stderr.decode()[-2000:]}}).encode()
            )
            target.with_suffix(".part").write_bytes(answer)
            target.with_suffix(".part").replace(target)
        print(f"{k} of {len(asked)}: {question}", flush=True)


def short(answer: Any) -> Any:
    """What a run says, without the arrays that it leaves: their last bits, and so digests of samples, are a processor's own."""
    return _without(answer.get("summary", answer))


def _without(answer: Any) -> Any:
    if isinstance(answer, dict):
        return {key: _without(value) for key, value in answer.items() if not LEFT_OUT.search(key)}
    return [_without(value) for value in answer] if isinstance(answer, list) else answer


def store() -> None:
    answers = {}
    for k, question in enumerate(SHORT, 1):
        done = _python(ROOT, Path(__file__).resolve(), "ask", question, check=True)
        answers[question] = short(json.loads(done.stdout)["answer"])
        print(f"{k} of {len(SHORT)}: {question}", flush=True)
    STORED.write_text(json.dumps(answers, indent=1) + "\n")


def audited(answer: Any) -> set[str]:
    """Digests of what was audited, wherever an answer tells of the book."""
    parts = answer.values() if isinstance(answer, dict) else answer if isinstance(answer, list) else ()
    own = {answer["audited"]} if isinstance(answer, dict) and "audited" in answer else set()
    return own.union(*map(audited, parts))


def worded(answer: Any) -> Any:
    """An answer without its numbers, and without digests of the book."""
    if isinstance(answer, dict):
        return {key: worded(value) for key, value in answer.items() if key not in ("book", "witness")}
    if isinstance(answer, list):
        return [worded(value) for value in answer]
    return answer if isinstance(answer, bool) else re.sub(r"[0-9a-f]{16,}|[-+.,\d]+(e-?\d+)?", "#", str(answer))


def differences(a: Any, b: Any, within: float, path: str = "") -> Iterator[str]:
    """Where two answers are not the same."""
    if not path and audited(a) != audited(b):
        a, b = worded(a), worded(b)
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted(a.keys() | b.keys()):
            if LEFT_OUT.search(key):
                continue
            if key in a and key in b:
                yield from differences(a[key], b[key], within, f"{path}/{key}")
            else:
                yield f"{path}/{key}: only {'before' if key in a else 'after'}"
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for k, (left, right) in enumerate(zip(a, b, strict=True)):
            yield from differences(left, right, within, f"{path}/{k}")
    elif isinstance(a, float) and isinstance(b, float | int) and not isinstance(b, bool):
        if not (math.isclose(a, b, rel_tol=within, abs_tol=within * 1e-3) or (math.isnan(a) and math.isnan(b))):
            yield f"{path}: {a!r}, {b!r}"
    elif a != b:
        yield f"{path}: {str(a)[:200]!r}, {str(b)[:200]!r}"


def compare(before: Path, after: Path, within: float) -> int:
    """0 where all that either folder has is the same."""
    names, wrong = sorted({p.name for folder in (before, after) for p in folder.glob("*.json")}), 0
    for name in names:
        sides = [json.loads((f / name).read_text()) if (f / name).exists() else {} for f in (before, after)]
        found = list(differences(*sides, within))
        wrong += bool(found)
        for line in found[:20]:
            print(f"{name}: {line}")
    print(f"{len(names) - wrong} of {len(names)} answers are the same, numbers within {within:g}")
    return int(wrong > 0 or not names)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    acts = parser.add_subparsers(dest="act", required=True)
    recorded = acts.add_parser("record")
    recorded.add_argument("folder", type=Path)
    recorded.add_argument("--checkout", type=Path, default=ROOT)
    recorded.add_argument("--only", default="")
    compared = acts.add_parser("compare")
    compared.add_argument("before", type=Path)
    compared.add_argument("after", type=Path)
    compared.add_argument("--within", type=float, default=1e-12)
    acts.add_parser("store")
    acts.add_parser("ask").add_argument("question")
    given = parser.parse_args()
    if given.act == "ask":
        print(json.dumps({"question": given.question, "answer": ask(given.question)}, default=str))
    elif given.act == "record":
        record(given.folder, given.checkout.resolve(), given.only)
    elif given.act == "store":
        store()
    else:
        return compare(given.before, given.after, given.within)
    return 0


if __name__ == "__main__":
    sys.exit(main())
