"""Drawn recordings with copies in them: cut, shifted, renamed, rounded, written in another format, thinned; and repetitions.

python tests/support/recorded_twice.py FIRST LAST    # seeds; prints copies that were missed, and what was taken for one
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import gapcert as gc
from gapcert_recordings import Copies, inspect

FORMS = ("noisy", "encoder", "exact", "thermal", "bursts", "many")
WAYS = ("cut", "shifted", "rounded", "digits", "single", "csv", "parquet", "thinned", "lost", "holes", "spliced", "restamped")


def measured(form: str, command: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Channels under one command (T,), which is the channel u: each call is another measurement."""
    n = len(command)
    level = np.convolve(command, np.exp(-np.arange(40) / 8) / 8)[:n]
    if form == "noisy":
        return {"u": command, "x": level + 0.01 * rng.normal(size=n)}
    if form == "encoder":  # counts of an encoder, with a noise from a tenth of a count to some
        angle, step = np.cumsum(level) * 0.2, 2 * np.pi / 4096
        return {"u": command, "x": step * np.round((angle + step * 10 ** rng.uniform(-1, 0.7) * rng.normal(size=n)) / step)}
    if form == "exact":  # a pendulum without friction or noise, from a start of its own
        angle, speed, out = rng.uniform(-1, 1), rng.uniform(-1, 1), []
        for u in command:
            out.append((angle, speed))
            speed += 0.05 * (u - np.sin(angle))
            angle += 0.05 * speed
        return {"u": command, "x": np.array(out)[:, 0], "v": np.array(out)[:, 1]}
    if form == "thermal":  # slow, and read in tenths
        slow = np.convolve(command, np.exp(-np.arange(200) / 60) / 6)[:n]
        return {"u": command, "x": np.round(20 + slow + 0.08 * rng.normal(size=n), 1)}
    if form == "bursts":  # at rest but for a while
        x = np.where((np.arange(n) > n // 3) & (np.arange(n) < 2 * n // 3), level + 0.003 * rng.normal(size=n), 0.0)
        return {"u": np.where(x == 0, 0.0, command), "x": x}
    return {"u": command} | {f"x{k}": (k + 1) * level + 10.0 ** rng.uniform(-4, -1) * rng.normal(size=n) for k in range(5)}


def commanded(n: int, rng: np.random.Generator) -> np.ndarray:
    kind = rng.integers(3)
    if kind == 0:
        return np.repeat(np.round(rng.uniform(-1, 1, n // 10 + 1), 2), 10)[:n]
    return np.sin(rng.uniform(0.05, 0.5) * np.arange(n)) if kind == 1 else np.cumsum(rng.normal(size=n)) * 0.1


def copied(way: str, tr: gc.Trajectory, other: gc.Trajectory, rng: np.random.Generator, folder: Path) -> gc.Trajectory:
    """The trajectory once more, as somebody might have kept it."""
    n = len(tr)
    if way == "cut":
        k = int(rng.integers(0, n // 2))
        tr = tr.part(k, k + n // 2)
    if way == "shifted":
        return gc.Trajectory(tr.t + float(rng.uniform(-100, 100)), tr.channels, "again")
    if way == "rounded":
        return with_values(tr, lambda v: np.round(v, 4))
    if way == "digits":
        return with_values(tr, lambda v: np.array([float(f"{a:.5g}") for a in v]))
    if way == "single":
        return with_values(tr, lambda v: v.astype(np.float32).astype(np.float64))
    if way == "thinned":
        return rows(tr, np.arange(int(rng.integers(3)), n, int(rng.integers(2, 4))))
    if way == "lost":
        return rows(tr, np.sort(rng.permutation(n)[: n - n // 50 - 1]))
    if way == "holes":
        hole = rng.random(n) < 0.01
        return with_values(tr, lambda v: np.where(hole, np.nan, v))
    if way == "spliced":
        k = n // 2
        mixed = {c: np.concatenate([tr.channels[c][:k], other.channels[c][:k]]) for c in tr.channels}
        return gc.Trajectory(np.arange(2 * k) * tr.period, mixed, "again")
    if way == "restamped":
        return gc.Trajectory(np.arange(n) * 0.013, tr.channels, "again")
    if way in ("csv", "parquet"):
        return rewritten(tr, way, folder)
    return gc.Trajectory(tr.t, tr.channels, "again")


def with_values(tr: gc.Trajectory, change) -> gc.Trajectory:
    return gc.Trajectory(tr.t, {c: change(v) for c, v in tr.channels.items()}, "again")


def rows(tr: gc.Trajectory, k: np.ndarray) -> gc.Trajectory:
    return gc.Trajectory(tr.t[k], {c: v[k] for c, v in tr.channels.items()}, "again")


def rewritten(tr: gc.Trajectory, way: str, folder: Path) -> gc.Trajectory:
    path = folder / f"log.{way}"
    table = {"t": tr.t, **tr.channels}
    if way == "csv":
        np.savetxt(path, np.stack(list(table.values()), axis=1), "%.9g", ",", header=",".join(table), comments="")
    else:
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table({c: v.astype(np.float32) for c, v in table.items()}), path)
    (one,) = inspect(path)
    return gc.Trajectory(one.t, {c.name: c.values for c in one.columns}, "again")


def drawn(seed: int, folder: Path) -> tuple[gc.Recording, set[str]]:
    """A recording, and the names of its trajectories that are copies in part at least."""
    rng = np.random.default_rng([seed, 5])
    form, way = FORMS[seed % len(FORMS)], WAYS[seed // len(FORMS) % len(WAYS)]
    n = int(rng.integers(200, 500))
    command = commanded(n, rng)
    made = []
    for k in range(int(rng.integers(2, 6))):
        # Some repeat the command, some do not; all measure for themselves.
        own = command if rng.random() < 0.7 else commanded(n, rng)
        made.append(gc.Trajectory(0.01 * np.arange(n), measured(form, own, rng), f"run {k}"))
    again = copied(way, made[0], made[1], rng, folder)
    again = gc.Trajectory(again.t, again.channels, "again")
    made.insert(int(rng.integers(1, len(made) + 1)), again)
    return gc.Recording(tuple(made)), {"again", "run 0"} | ({"run 1"} if way == "spliced" else set())


def main(first: int, last: int) -> int:
    missed = wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, last):
            recording, twice = drawn(seed, Path(folder))
            found = {c.name for c in Copies.of(recording, ("u",)).found}
            what = f"seed {seed} ({FORMS[seed % len(FORMS)]}, {WAYS[seed // len(FORMS) % len(WAYS)]})"
            if not found & twice:
                missed += 1
                print(f"{what}: missed", flush=True)
            if found - twice:
                wrong += 1
                print(f"{what}: took {sorted(found - twice)} for copies", flush=True)
    print(f"{last - first} recordings: {missed} copies missed, {wrong} with false ones")
    return int(missed + wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main(int(sys.argv[1]), int(sys.argv[2])))
