"""The contract that every observer keeps, as named checks around a small run."""

from __future__ import annotations

import io
import tempfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from gapcert.certification.certificate import Certificate
from gapcert.contracts.plugins.events import Event
from gapcert.numerics.errors import UsageError
from gapcert.run.run import Run, run
from gapcert.testing.checks import expect
from gapcert.testing.toys import PLAIN

SPEC: Mapping[str, Any] = {
    "version": 1,
    "name": "observed",
    "model": PLAIN,
    "backend": {**PLAIN, "parameters": {"k": "0.6 Hz"}, "integrator": "euler"},
    "domain": {"q": ["-1 m/s", "1 m/s"], "u": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 40, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope", "predictor": "affine"},
    "certificate": {"claim": "deterministic", "violation": 0.01},
    "report": {"html": False, "rerun": False},
}
"""A certificate that takes a second."""


class ObserverContract(ABC):
    """Subclass in a test module as `Test…` and supply `observer`: pytest then runs every `test_…` below on it.

    `seen` (optional) says what the observer left in the folder of a run, for `test_tells_of_every_stage`; `spec` is what is
    run.
    """

    spec = SPEC

    @abstractmethod
    def observer(self) -> Callable[[Event], None]:
        """The plugin's `gapcert_event`."""

    def seen(self, folder: Path) -> str | None:
        """What it wrote about the run in this folder; None where it writes elsewhere, or nothing."""
        return None

    def test_watches_a_run(self) -> None:
        """It takes every event, with what the events carry, and is not dropped."""
        with tempfile.TemporaryDirectory() as out:
            _, complaints = self._run(Path(out), [self.observer()])
        expect(not complaints, f"it was dropped, or warned: {'; '.join(complaints)}")

    def test_changes_nothing(self) -> None:
        """The same certificate, bit for bit, with it and without it."""
        with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
            (watched, _), (alone, _) = self._run(Path(first), [self.observer()]), self._run(Path(second), [])
            expect(_digests(watched) == _digests(alone), "a run that it watches ends in another certificate")

    def test_leaves_standard_output_alone(self) -> None:
        """`gapcert run --json` prints one JSON value there, and nothing else."""
        said = io.StringIO()
        with tempfile.TemporaryDirectory() as out, redirect_stdout(said):
            self._run(Path(out), [self.observer()])
        expect(not said.getvalue(), f"it printed to standard output: {said.getvalue()[:200]!r}; use standard error, or a file")

    def test_tells_of_every_stage(self) -> None:
        with tempfile.TemporaryDirectory() as out:
            stages: list[str] = []

            def note(event: Event) -> None:
                stages.extend([event.stage] if event.name == "stage-finished" else [])

            done, _ = self._run(Path(out), [self.observer(), note])
            if (text := self.seen(done.folder)) is not None:
                lost = [s for s in stages if s not in text]
                expect(not lost, f"it says nothing about {', '.join(lost)}")

    def test_survives_a_run_that_never_ends(self) -> None:
        """A run is interrupted, the next one begins, and what comes late still comes."""
        with tempfile.TemporaryDirectory() as name:
            started = Event("run-started", "run", {"name": "a", "spec": {}, "folder": Path(name), "rerun": None, "view": False})
            self._tell([started, Event("stage-started", "sampling"), started, _finished("sampling")])

    def test_survives_a_start_in_the_middle(self) -> None:
        late = Event("progress", "fit", {"done": 1, "total": 2}), Event("warning", "fit", {"message": "?"})
        ended = Event("run-finished", "run", {"summary": {}, "folder": Path("nowhere")})
        self._tell([_finished("sampling"), *late, ended])

    def test_survives_what_it_does_not_know(self) -> None:
        """Events and what they carry grow with Gapcert."""
        name: Any = "something-new"
        self._tell([Event(name, "a stage of tomorrow", {"data": object()}), Event("stage-finished", "a stage of tomorrow")])

    def _tell(self, events: Sequence[Event]) -> None:
        observer = self.observer()
        for event in events:
            try:
                observer(event)
            except Exception as error:
                raise AssertionError(f"{event.name} of '{event.stage}' ended in {type(error).__name__}: {error}") from error

    def _run(self, out: Path, observers: list[Callable[[Event], None]]) -> tuple[Run, list[str]]:
        with warnings.catch_warnings(record=True) as complaints:
            warnings.simplefilter("always")
            done = run(self.spec, out=out, observers=observers)
        return done, [str(w.message) for w in complaints]


def _finished(stage: str) -> Event:
    return Event("stage-finished", stage, {"seconds": 0.5})


def _digests(done: Run) -> Any:
    certificate = done.certificate
    if not isinstance(certificate, Certificate):
        raise UsageError("observed: the run made no certificate; see its summary")
    return certificate.digests, {k: v.tobytes() for k, v in certificate.gap.arrays().items()}
