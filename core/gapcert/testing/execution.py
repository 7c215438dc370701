"""The contract that every executor keeps, as named checks."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from concurrent.futures import Executor, Future, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.certification.samples.store import Store
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.domain import Cover, Domain
from gapcert.numerics.arrays import Array
from gapcert.testing.checks import expect
from gapcert.testing.toys import Drift, Perturbed, ripple


class ExecutorContract(ABC):
    """Subclass in a test module as `Test…` and supply `executor`: pytest then runs every `test_…` below on it."""

    patience = 120.0

    @abstractmethod
    def executor(self, workers: int) -> Executor:
        """What the component's function makes for so many workers."""

    def test_is_an_executor(self) -> None:
        with self._made(2) as pool:
            expect(isinstance(pool, Executor), f"it is {type(pool).__name__}; expected a concurrent.futures.Executor")

    def test_says_how_many_work(self) -> None:
        with self._made(2) as pool:
            workers = getattr(pool, "workers", 2)
            expect(isinstance(workers, int) and workers >= 1, f"workers is {workers!r}; expected a positive integer")
            remote = getattr(pool, "remote", False)
            expect(isinstance(remote, bool), f"remote is {remote!r}; expected True or False")

    def test_answers_are_those_of_this_process(self) -> None:
        z = np.random.default_rng(31).uniform(-1, 1, (200, 4))
        with self._made(2) as pool:
            futures = [pool.submit(ripple, part) for part in np.array_split(z, 7)]
            expect(all(isinstance(f, Future) for f in futures), "submit did not return a concurrent.futures.Future")
            there = np.concatenate([f.result(self.patience) for f in futures])
        expect(there.tobytes() == ripple(z).tobytes(), "a function gave other bits there than here")

    def test_takes_named_arguments(self) -> None:
        with self._made(1) as pool:
            expect(pool.submit(_power, 3, to=4).result(self.patience) == 81, "named arguments do not reach the function")

    def test_errors_come_back_as_they_were(self) -> None:
        with self._made(1) as pool:
            error = pool.submit(_fail, "measured 3").exception(self.patience)
            expect(isinstance(error, ValueError), f"a ValueError came back as {type(error).__name__}")
            expect(str(error) == "measured 3", f"its message came back as '{error}'")
            expect(pool.submit(_power, 2, to=3).result(self.patience) == 8, "after an error nothing is computed any more")

    def test_more_tasks_than_workers(self) -> None:
        with self._made(2) as pool:
            futures = [pool.submit(_power, k, to=2) for k in range(50)]
            _, late = wait(futures, self.patience)
            expect(not late, f"{len(late)} of 50 tasks never ended")
            expect([f.result() for f in futures] == [k * k for k in range(50)], "tasks came back with each other's results")

    def test_ends_when_told(self) -> None:
        pool = self.executor(1)
        first = pool.submit(_power, 2, to=5)
        pool.shutdown()
        expect(first.result(self.patience) == 32, "shutdown lost a task that it had taken")
        try:
            pool.submit(_power, 2, to=5)
        except RuntimeError:
            return
        raise AssertionError("after its shutdown it takes tasks; expected RuntimeError")

    def test_samples_do_not_depend_on_workers(self) -> None:
        """Rounds of samples have one digest, however many compute them."""
        answers = [self._collected(workers) for workers in (1, 3)]
        model = Drift(1)
        here = Residual(Perturbed(model, ripple), model)(_cover().chunk(0, 500))
        for r, _ in answers:
            expect(r.tobytes() == here.tobytes(), "samples are not those of this process")
        expect(answers[0][1] == answers[1][1], "rounds have another digest with another number of workers")

    def _collected(self, workers: int) -> tuple[Array, dict[str, str]]:
        model = Drift(1)
        with tempfile.TemporaryDirectory() as folder:
            store = Store(Path(folder), Residual(Perturbed(model, ripple), model), "key", lambda: self.executor(workers), 60)
            try:
                return store.collect("r", _cover()), store.digests
            except OSError as error:
                hint = "set remote = True where workers do not write to the disk of this machine"
                raise AssertionError(f"a shard is not where it should be ({error}); {hint}") from error

    @contextmanager
    def _made(self, workers: int) -> Iterator[Any]:
        pool = self.executor(workers)
        try:
            yield pool
        finally:
            pool.shutdown()


def _cover() -> Cover:
    return Cover(Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}), (20, 25))


def _power(base: int, *, to: int) -> int:
    return int(base**to)


def _fail(message: str) -> None:
    raise ValueError(message)
