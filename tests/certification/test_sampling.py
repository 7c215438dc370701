"""Rounds, shards and resume: the same bits, whoever computes them and however often they are killed."""

import itertools
import json
import os
import subprocess
import sys
from concurrent.futures import BrokenExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import sigkill

from gapcert import Box, Domain, GapcertError, StateSpec, UsageError
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling
from gapcert.certification.samples.executors import processes, threads
from gapcert.certification.samples.store import Store
from gapcert.numerics.atomic_files import write_atomic
from gapcert.plugin import Cover, Points, Residual
from gapcert.testing.toys import Drift, Perturbed, ripple


def residual() -> Residual:
    model = Drift(1)
    return Residual(Perturbed(model, ripple), model)


def domain() -> Domain:
    return Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)})


def _rooted(z: np.ndarray) -> np.ndarray:
    return np.sqrt(z[:, :1])


def store(folder: Path, **options) -> Store:
    return Store(folder, residual(), "key", **{"chunk": 100, **options})


def test_a_round_is_the_residual_at_its_points(tmp_path):
    cover = Cover(domain(), (20, 30))
    r = store(tmp_path).collect("bound-0", cover)
    np.testing.assert_array_equal(r, residual()(cover.chunk(0, 600)))


@pytest.mark.parametrize("executor", [processes, threads], ids=["processes", "threads"])
def test_executors_agree_bit_for_bit(tmp_path, executor):
    cover = Cover(domain(), (20, 30))
    one, many = store(tmp_path / "one", chunk=1000), store(tmp_path / "many", executor=lambda: executor(2))
    np.testing.assert_array_equal(one.collect("a", cover), many.collect("a", cover))


def test_digest_does_not_depend_on_workers_and_points_survive(tmp_path):
    z = domain().draw(250, np.random.default_rng(0))
    a, b = store(tmp_path / "a", executor=lambda: threads(1)), store(tmp_path / "b", executor=lambda: threads(3))
    a.collect("r", Points(z))
    b.collect("r", Points(z))
    assert a.digests == b.digests
    np.testing.assert_array_equal(np.load(tmp_path / "a" / "r" / "points.npy"), z)


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(
            "missing shard",
            id="missing shard",
            marks=pytest.mark.fault("a shard is deleted", shows="it is computed again, to the same digest"),
        ),
        pytest.param(
            "truncated shard",
            id="truncated shard",
            marks=pytest.mark.fault("a shard is cut off", shows="it is computed again, to the same digest"),
        ),
        pytest.param(
            "foreign bytes",
            id="foreign bytes",
            marks=pytest.mark.fault("a shard holds other bytes", shows="it is computed again, to the same digest"),
        ),
        pytest.param(
            "cut manifest",
            id="cut manifest",
            marks=pytest.mark.fault("a manifest's last line is cut off", shows="it is computed again, to the same digest"),
        ),
    ],
)
def test_damage_is_mended_to_the_same_digest(tmp_path, damage):
    cover = Cover(domain(), (20, 30))
    first = store(tmp_path, executor=lambda: threads(2))
    first.collect("r", cover)
    shard, manifest = tmp_path / "r" / "chunk-000003.npy", tmp_path / "r" / "manifest.jsonl"
    if damage == "missing shard":
        shard.unlink()
    elif damage == "truncated shard":
        shard.write_bytes(shard.read_bytes()[:50])
    elif damage == "foreign bytes":
        shard.write_bytes(b"x" * 200)
    else:
        manifest.write_text(manifest.read_text()[:-30])
    again = store(tmp_path, executor=lambda: threads(2))
    np.testing.assert_array_equal(again.collect("r", cover), residual()(cover.chunk(0, 600)))
    assert again.digests == first.digests
    assert all(json.loads(line) for line in manifest.read_text().splitlines())


def test_finished_shards_are_not_computed_again(tmp_path):
    cover = Cover(domain(), (20, 30))
    store(tmp_path, executor=lambda: threads(2)).collect("r", cover)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "r").glob("chunk-*")}
    store(tmp_path, executor=lambda: threads(2)).collect("r", cover)
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "r").glob("chunk-*")}


def test_a_folder_of_another_question_is_refused(tmp_path):
    store(tmp_path).collect("r", Cover(domain(), (5, 5)))
    with pytest.raises(UsageError, match=r"another question: model, backend or domain have another digest .*; choose"):
        Store(tmp_path, residual(), "other key", chunk=100).collect("r", Cover(domain(), (5, 5)))
    with pytest.raises(UsageError, match="the points are others, and there are 25 points, now 30"):
        store(tmp_path).collect("r", Cover(domain(), (5, 6)))
    with pytest.raises(UsageError, match=f"sampling.chunk was 100, now 50; .* delete {tmp_path / 'r'} to start anew"):
        Store(tmp_path, residual(), "key", chunk=50).collect("r", Cover(domain(), (5, 5)))


def test_the_folder_of_a_run_is_named_as_what_to_delete(tmp_path):
    store(tmp_path / "run" / "samples").collect("r", Cover(domain(), (5, 5)))
    with pytest.raises(UsageError, match=f"delete {tmp_path / 'run'} to start anew"):
        Store(tmp_path / "run" / "samples", residual(), "other key", chunk=100).collect("r", Cover(domain(), (5, 5)))


def test_a_full_disk_leaves_no_half_written_shard(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UsageError, match=r"disk is full.*shards are kept"):
        write_atomic(tmp_path / "chunk", b"data")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault("a residual that is not finite", shows="at which state and input")
def test_non_finite_residuals_are_named(tmp_path):
    model = Drift(1)
    with pytest.raises(GapcertError, match=r"the residual at \(x, u\) = .* is \[nan\]"), np.errstate(invalid="ignore"):
        Store(tmp_path, Residual(Perturbed(model, _rooted), model), "k").collect("r", Points(np.array([[-1.0, 1.0]])))


def test_cover_radius_is_exact_and_covers():
    cover = Cover(domain(), (7, 9))
    h, z = cover.half_widths(), domain().draw(5000, np.random.default_rng(1))
    distance = np.abs(z[:, None] - cover.chunk(0, 63)[None])
    assert ((distance <= h).all(axis=2)).any(axis=1).all()
    assert not ((distance <= h * 0.97).all(axis=2)).any(axis=1).all()
    assert cover.radii()[0] >= 1 / 7


def test_cover_radius_holds_in_exact_arithmetic():
    rng = np.random.default_rng(3)
    for low, width, counts in zip(
        rng.normal(size=(200, 2)), rng.uniform(0.1, 3, (200, 2)), rng.integers(1, 9, (200, 2)), strict=True
    ):
        cover = Cover(
            Domain.of(Drift(1), {"x0": (low[0], low[0] + width[0]), "u0": (low[1], low[1] + width[1])}), tuple(counts.tolist())
        )
        for j, h in enumerate(cover.half_widths()):
            points = list(map(Fraction, cover.axis(j)))
            ends = points[0] - Fraction(cover.domain.low[j]), Fraction(cover.domain.high[j]) - points[-1]
            assert Fraction(h) >= max(*ends, *((b - a) / 2 for a, b in itertools.pairwise(points)))


def test_the_paper_grid():
    axes = (StateSpec("theta", "rad"), StateSpec("omega", "rad/s"))
    z = Domain(Box(axes, (-0.2, -0.25), (0.2, 0.25)), Box((StateSpec("torque", "N*m"),), (-1.0,), (1.0,)))
    grid = GridSampling.covering(z, 0.0022, 0.01).first(z)
    assert grid.counts == (129, 161, 100)
    assert len(grid) == 2_076_900
    assert grid.radii()[0] <= 0.0022 + 1e-15
    assert grid.radii()[1] == pytest.approx(0.01, rel=1e-12)
    assert grid.radii()[1] >= 0.01


def test_adaptive_points_stay_in_the_domain_and_follow_the_constants():
    z = domain()
    plan = AdaptiveSampling(101)
    first = plan.first(z).z
    further = plan.further(z, first, residual()(first), np.array([[0.0, 1.0]]))
    assert len(first) + len(further) in (100, 101)
    assert z.contains(further).all()
    assert len(np.unique(np.vstack([first, further]), axis=0)) == len(first) + len(further)
    # Only u0 has a slope: no further point may differ from a first one in x0.
    assert set(further[:, 0]) <= set(first[:, 0])


def test_a_first_round_that_sees_no_gap_says_nothing_of_a_state():
    """That state does not take all further points: along the axis of the other one there are new values, too."""
    z, plan = domain(), AdaptiveSampling(101)
    first = plan.first(z).z
    r = np.column_stack([np.abs(first[:, 1]), np.zeros(len(first))])
    further = plan.further(z, first, r, np.array([[0.0, 1.0], [0.5, 0.0]]))
    assert min(len(set(column) - set(known)) for column, known in zip(further.T, first.T, strict=True)) > 3


def test_adaptive_beats_the_same_number_of_grid_points():
    z = domain()
    plan = AdaptiveSampling(121)
    first = plan.first(z).z
    points = np.vstack([first, plan.further(z, first, residual()(first), np.array([[0.001, 0.08]]))])
    grid = Cover(z, (11, 11)).chunk(0, 121)
    test = z.draw(4000, np.random.default_rng(0))

    def width(samples, slopes):
        return (np.abs(test[:, None] - samples[None]) * slopes).sum(axis=2).min(axis=1).mean()

    assert width(points, np.array([0.001, 0.08])) < 0.7 * width(grid, np.array([0.001, 0.08]))


KILLED = """
import sys
from concurrent.futures import BrokenExecutor
from pathlib import Path
import numpy as np
from gapcert import Domain
from gapcert.plugin import Cover
from gapcert.certification.samples.executors import processes
from gapcert.certification.samples.store import Store
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert.plugin import Residual
if __name__ == "__main__":
    model = Drift(1)
    z = Domain.of(model, {"x0": (-1, 1), "u0": (-2, 2)})
    s = Store(Path(sys.argv[1]), Residual(Perturbed(model, ripple), model), "key", lambda: processes(2), chunk=2000)
    s.collect("r", Cover(z, (500, 400)))
    print(s.digests["r"])
"""


@pytest.mark.exam
@pytest.mark.fault(
    "the main process and its workers are killed (SIGKILL) while they sample", shows="the same command ends in the same digests"
)
def test_sigkill_at_random_moments_then_resume(tmp_path):
    script = tmp_path / "killed.py"
    script.write_text("import sigkill\n" + KILLED)
    rng = np.random.default_rng(3)
    for _ in range(3):
        sigkill.killed([sys.executable, script, tmp_path / "a"], rng, (1, 25))
    resumed, whole = (sigkill.whole([sys.executable, script, tmp_path / folder]) for folder in "ab")
    assert resumed.stdout == whole.stdout != ""


@pytest.mark.contract
@pytest.mark.fault("Ctrl-C while samples are drawn", shows="how to go on, exit 4")
def test_ctrl_c_says_how_to_go_on(tmp_path):
    script = tmp_path / "slow.py"
    press = "import os, signal\npress = lambda e: e.data['done'] == 5000 and os.killpg(0, signal.SIGINT)\n"
    script.write_text(press + KILLED.replace("chunk=2000", "chunk=500, emit=press"))
    command = [sys.executable, script, tmp_path / "a"]
    ended = subprocess.run(command, stderr=subprocess.PIPE, text=True, start_new_session=True, check=False)
    assert ended.returncode != 0
    assert "run the same command again" in ended.stderr


@pytest.mark.exam
@pytest.mark.parametrize("how", ["a script without a main guard", "standard input"])
def test_workers_do_not_run_the_users_script_again(tmp_path, how):
    text = KILLED.replace('if __name__ == "__main__":', 'print("once", flush=True)\nif True:').replace("400)", "40)")
    script = tmp_path / "script.py"
    script.write_text(text)
    command = [sys.executable, script, tmp_path / "a"] if how.startswith("a script") else [sys.executable, "-", tmp_path / "a"]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    assert done.stdout.count("once") == 1
    assert done.stderr == ""
    assert len(list(tmp_path.glob("a/r/chunk-*"))) == 10


@pytest.mark.contract
def test_a_system_of_the_running_script_is_computed_in_this_process(tmp_path):
    text = KILLED.replace(
        "from gapcert.plugin import Residual", "from gapcert.plugin import Residual\ndef mine(z):\n    return 0.1 * z[:, :1]"
    )
    script = tmp_path / "script.py"
    script.write_text(text.replace("Perturbed(model, ripple)", "Perturbed(model, mine)").replace("400)", "40)"))
    subprocess.run([sys.executable, script, tmp_path / "a"], capture_output=True, text=True, check=True)
    assert len(list(tmp_path.glob("a/r/chunk-*"))) == 10


class Doomed:
    """An executor whose workers die `times` times, then a healthy one."""

    def __init__(self, times: int) -> None:
        self.times, self.made = times, 0

    def __call__(self):
        self.made += 1
        pool = threads(1)
        if self.made <= self.times:
            submit, calls = pool.submit, []

            def dying(*task):
                calls.append(task)
                if len(calls) > 2:
                    raise BrokenExecutor("a worker died")
                return submit(*task)

            pool.submit = dying
        return pool


def test_lost_workers_are_replaced_once(tmp_path):
    cover, heard = Cover(domain(), (20, 30)), []
    doomed = Doomed(1)
    r = store(tmp_path, executor=doomed, emit=heard.append).collect("r", cover)
    np.testing.assert_array_equal(r, residual()(cover.chunk(0, 600)))
    assert doomed.made == 2
    assert [e.name for e in heard].count("warning") == 1


def test_workers_that_die_again_end_the_run_resumably(tmp_path):
    cover = Cover(domain(), (20, 30))
    with pytest.raises(GapcertError, match="workers died twice in round 'r'") as error:
        store(tmp_path, executor=Doomed(2)).collect("r", cover)
    assert error.value.exit_code == 4
    np.testing.assert_array_equal(store(tmp_path, executor=Doomed(0)).collect("r", cover), residual()(cover.chunk(0, 600)))
