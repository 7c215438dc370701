"""`python tests/fuzz/fuzz.py TARGET [-max_total_time=600] [libFuzzer's options]`: follow coverage with Atheris.

`python tests/fuzz/fuzz.py --random TARGET SECONDS [SEED]` mutates real files without Atheris, tells each distinct failure once
and keeps its input in found/TARGET/.
"""

import hashlib
import random
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from fuzzing import FOUND, TARGETS, mutate


def kept(name: str, data: bytes) -> Path:
    """An input that broke the rule, as a file."""
    path = FOUND / name / hashlib.sha256(data).hexdigest()[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def at_random(name: str, seconds: float, seed: int) -> int:
    """How many distinct failures there were."""
    target, rng = TARGETS[name], random.Random(seed)
    seeds, seen, count = target.seeds(), set(), 0
    end = time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as place:
        while time.monotonic() < end:
            data = mutate(rng.choice(seeds), rng)
            (FOUND.parent / "last").write_bytes(data)  # what a crash of the whole process leaves
            count += 1
            try:
                target.run(data, Path(place))
            except Exception as error:
                last = traceback.extract_tb(error.__traceback__)[-1]
                what = str(error).strip().splitlines()
                key = (type(error).__name__, last.filename, last.lineno, what[-1][:60] if what else "")
                if key not in seen:
                    seen.add(key)
                    print(f"--- {kept(name, data)}\n{type(error).__name__}: {str(error)[-1500:]}", flush=True)
    print(f"{name}: {count} executions, {len(seen)} findings", flush=True)
    return len(seen)


def by_coverage(name: str, arguments: list[str]) -> None:
    """Ends the process."""
    import atheris

    with atheris.instrument_imports(include=["gapcert", "gapcert_equations", "gapcert_readers", "gapcert_mpc"]):
        pass
    target = TARGETS[name]
    corpus = Path(tempfile.mkdtemp(prefix=f"gapcert-fuzz-{name}-"))
    for k, data in enumerate(target.seeds()):
        (corpus / f"seed-{k}").write_bytes(data)
    place = Path(tempfile.mkdtemp(prefix="gapcert-fuzz-"))

    def one(data: bytes) -> None:
        try:
            target.run(data, place)
        except Exception:
            print(f"--- {kept(name, data)}", flush=True)
            raise

    def custom(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        return (mutate(data, rng) if rng.random() < 0.5 else atheris.Mutate(data, most))[:most]

    atheris.Setup([sys.argv[0], str(corpus), *arguments], one, custom_mutator=custom)
    atheris.Fuzz()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    asked = sys.argv[2:3] if sys.argv[1:2] == ["--random"] else sys.argv[1:2]
    if not set(asked) & set(TARGETS):
        sys.exit(f"{__doc__}\nTargets: {', '.join(TARGETS)}")
    if sys.argv[1] == "--random":
        sys.exit(at_random(sys.argv[2], float(sys.argv[3]), int((sys.argv[4:] or ["0"])[0])) > 0)
    by_coverage(sys.argv[1], sys.argv[2:])
