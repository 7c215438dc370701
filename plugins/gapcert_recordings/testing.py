"""The contract that every Reader keeps, as named checks on files that its author writes."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gapcert.plugin import Reader, Recording, Trajectory, UsageError, expect


class ReaderContract(ABC):
    """Subclass in a test module as `Test…` and supply `write`: pytest then runs every `test_…` below on it.

    exact: how far numbers may come back from what was written, relative to the largest; several, missing: can a file, or
    several, hold more than one trajectory, or a number that is missing?
    """

    exact = 1e-9
    several = True
    missing = True

    @abstractmethod
    def write(self, recording: Recording, folder: Path) -> Reader:
        """Write the recording into the folder as a logger would, and return its reader, built as a spec would build it.

        Its channels have the names of the recording's. The file or files are all that the folder holds.
        """

    def recording(self, trajectories: int = 1, gap: bool = False) -> Recording:
        """An angle and a torque: uneven times that begin late; with a gap, one number is missing."""
        rng, made = np.random.default_rng(21), []
        for k in range(trajectories):
            t = 0.5 + np.cumsum(0.01 + 0.002 * rng.random(40 + 5 * k))
            channels = {"angle": np.sin(3 * t) * (k + 1), "torque": 1e-3 * np.cos(t) - 2.0}
            if gap:
                channels["angle"][7] = np.nan
            made.append(Trajectory(t, channels, str(k)))
        return Recording(tuple(made))

    def test_numbers_come_back(self) -> None:
        with self._written(self.recording()) as (reader, _):
            self._equal(reader.read(), self.recording())

    def test_trajectories_come_back_in_order(self) -> None:
        if self.several:
            with self._written(self.recording(3)) as (reader, _):
                self._equal(reader.read(), self.recording(3))

    def test_what_is_missing_stays_missing(self) -> None:
        if self.missing:
            with self._written(self.recording(gap=True)) as (reader, _):
                self._equal(reader.read(), self.recording(gap=True))

    def test_reading_again_gives_the_same(self) -> None:
        with self._written(self.recording()) as (reader, _):
            expect(reader.read().digest() == reader.read().digest(), "a second look at the same file gave other numbers")

    def test_files_are_not_changed(self) -> None:
        with self._written(self.recording()) as (reader, folder):
            before = {p: p.read_bytes() for p in _files(folder)}
            reader.read()
            expect({p: p.read_bytes() for p in _files(folder)} == before, "reading changed, added or removed a file")

    def test_an_absent_file_is_a_sentence(self) -> None:
        with self._written(self.recording()) as (reader, folder):
            first = _files(folder)[0]
            for path in _files(folder):
                path.unlink()
            self._refused(reader, first, "which is not there,")

    def test_another_format_is_a_sentence(self) -> None:
        for what, content in (
            ("empty", b""),
            ("noise", np.random.default_rng(3).bytes(4096)),
            ("prose", b"Dear diary,\n\nno.\n"),
        ):
            with self._written(self.recording()) as (reader, folder):
                for path in _files(folder):
                    path.write_bytes(content)
                self._refused(reader, _files(folder)[0], f"which is {what},")

    def test_a_cut_file_is_a_sentence_or_shorter(self) -> None:
        """A logger that lost its power: nothing is made up."""
        with self._written(self.recording()) as (reader, folder):
            for path in _files(folder):
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
            try:
                found = reader.read().trajectories[0]
            except UsageError:
                return
            n, whole = len(found) - 1, self.recording().trajectories[0]  # the last row may have lost digits
            expect(n < len(whole), "half of a file gave as many samples as the whole")
            same = bool(np.allclose(found.t[:n], whole.t[:n], rtol=self.exact))
            expect(same, "half of a file gave times that were never logged")

    def test_tables_show_what_is_there(self) -> None:
        """Every channel and the time stand among the columns, whatever they are called there."""
        with self._written(self.recording()) as (reader, folder):
            tables = [t for path in _files(folder) for t in type(reader).tables(path)]
            if not tables:
                expect(not reader.suffixes, f"suffixes are {reader.suffixes}, and `tables` finds nothing in such a file")
                return
            columns = [np.asarray(c) for _, table in tables for c in table.values()]
            truth = self.recording().trajectories[0]
            for name, values in {"the time": truth.t, **truth.channels}.items():
                near = any(c.shape == values.shape and c.dtype.kind in "fiu" and self._near(c, values) for c in columns)
                expect(near, f"`tables` has no column that holds {name}")

    def test_suffixes_are_suffixes(self) -> None:
        with self._written(self.recording()) as (reader, folder):
            odd = [s for s in reader.suffixes if not s.startswith(".") or s != s.lower()]
            expect(not odd, f"suffixes {odd}; expected such as '.csv', in lower case")
            ends = {p.suffix for p in _files(folder)}
            known = not reader.suffixes or bool(ends & set(reader.suffixes))
            expect(known, f"files end in {ends}, suffixes are {reader.suffixes}")

    @contextmanager
    def _written(self, recording: Recording) -> Iterator[tuple[Reader, Path]]:
        with tempfile.TemporaryDirectory() as name:
            yield self.write(recording, Path(name)), Path(name)

    def _near(self, a: np.ndarray, b: np.ndarray) -> bool:
        return bool(np.allclose(a, b, rtol=0, atol=self.exact * np.nanmax(np.abs(b)), equal_nan=True))

    def _equal(self, found: Recording, wanted: Recording) -> None:
        expect(set(found.names) == set(wanted.names), f"channels are {sorted(found.names)}; expected {sorted(wanted.names)}")
        count = len(wanted.trajectories)
        expect(len(found.trajectories) == count, f"{len(found.trajectories)} trajectories came back of {count}")
        for k, (a, b) in enumerate(zip(found.trajectories, wanted.trajectories, strict=True)):
            expect(len(a) == len(b), f"trajectory {k} has {len(a)} samples; {len(b)} were written")
            expect(self._near(a.t, b.t), f"times of trajectory {k} differ by {np.abs(a.t - b.t).max():.3g} s")
            for name in wanted.names:
                expect(self._near(a.channels[name], b.channels[name]), f"'{name}' of trajectory {k} came back as other numbers")

    def _refused(self, reader: Reader, path: Path, what: str) -> None:
        try:
            reader.read()
        except UsageError as error:
            expect(path.name in str(error), f"the sentence about {path.name} does not name it: {error}")
            return
        raise AssertionError(f"{path.name}, {what} was read; expected UsageError")


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())
