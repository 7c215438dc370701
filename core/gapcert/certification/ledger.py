"""The book: how often each question has been audited, in one JSON file beside the run folders."""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

import numpy as np

from gapcert.certification.fingerprint import Fingerprint, Known
from gapcert.numerics import order_statistics
from gapcert.numerics.atomic_files import DAMAGE, write_atomic
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError

FORMAT = 2
Kind = Literal["audit", "calibration", "closed loop", "hidden state"]
"""What is counted apart, each against a β of its own."""


class Line(NamedTuple):
    """Of the book: of this kind, `audited` (a digest) is number k of the question."""

    question: str
    kind: str
    k: int
    audited: str


@final
@dataclass(frozen=True)
class Entry:
    """Audit k of a question and kind, which may spend β_k = β / 2^k, so that all together spend at most β.

    question: its name; empty for an audit of a book before format 2. lost: how many audits that run folders tell of are not in
    the book; edited: it was changed by others than runs.
    """

    k: int
    kind: Kind = "audit"
    question: str = ""
    audited: str = ""
    lost: int = 0
    edited: bool = False

    def draws(self, seed: int, stream: str) -> np.random.Generator:
        """What its points are drawn from; every `stream` has its own."""
        return order_statistics.drawing(seed, self.k, stream, self.question, self.audited)

    def summary(self) -> dict[str, Any]:
        """`number`, and in `book` by what the book knows it; JSON-able."""
        if not self.question:
            return {"number": self.k}
        book = {"kind": self.kind, "question": self.question, "audited": self.audited}
        damage = {k: v for k, v in (("lost", self.lost), ("edited", self.edited)) if v}
        return {"number": self.k, "book": book | damage}

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with the book, in a sentence each."""
        found = []
        if self.lost:
            found.append(
                f"the book of audits has been lost or replaced: it lacks {self.lost} that run folders beside it tell of; those "
                f"were counted, and others that it had cannot be"
            )
        if self.edited:
            found.append("the book of audits was edited: what was taken out of it is not counted, and β may be spent twice")
        return tuple(found)

    @property
    def sentences(self) -> list[str]:
        """The same among what a claim rests on."""
        return [f"Warning: {w}." for w in self.warnings]


@final
@dataclass(frozen=True)
class Ledger:
    """The audits of each question, by kind. An entry is written before anything is drawn: an audit that was begun counts.

    The same audited object again is the same audit. A book before format 2 is kept in it: it has the audits of each spelling.
    """

    path: Path

    def enter(self, asked: Fingerprint, kind: Kind, audited: str) -> Entry:
        """The entry of `audited`, a text that tells it from all others; a new one is recorded under an exclusive lock."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # Opened as it is: a lock has no content to be truncated, wherever a link may lead.
        with open(self.path.with_suffix(".lock"), "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return self._entered(asked, kind, audited)

    def _entered(self, asked: Fingerprint, kind: Kind, audited: str) -> Entry:
        book = self._book()
        if audited in (old := book["older"].get(asked.digest, [])):
            return Entry(old.index(audited) + 1, kind)
        question, digest = _question(book, asked), hashlib.sha256(audited.encode()).hexdigest()
        lines, name = {Line(*line) for line in book["lines"]}, question["name"]
        lost = self._told() - lines
        # A name that the book does not have may be that of any question, and so of this one.
        others = {q["name"] for q in book["questions"]} - {name}
        own = [line for line in lines | lost if line.kind == kind and line.question not in others]
        before = [text for spelling in question["spellings"] for text in book["older"].get(spelling, []) if _kind(text) == kind]
        again = next((line.k for line in own if line.audited == digest), None)
        k = 1 + max([len(before), *(line.k for line in own)]) if again is None else again
        if again is None:
            book["lines"].append(Line(name, kind, k, digest))
        self._write(book)
        return Entry(k, kind, name, digest, len(lost), book["edited"])

    def _book(self) -> dict[str, Any]:
        """What has been counted. A book that cannot be read is never begun anew: that would spend β twice."""
        if not self.path.exists():
            return {"format": FORMAT, "questions": [], "lines": [], "older": {}, "edited": False, "seal": ""}
        try:
            book = json.loads(self.path.read_text(encoding="utf-8"))
            if "format" not in book:
                book = {"format": FORMAT, "questions": [], "lines": [], "older": book, "edited": False, "seal": ""}
            elif book["format"] != FORMAT:
                raise ValueError(f"it has format {book['format']!r}, and {FORMAT} is known")
            elif book["seal"] != _seal(book):
                book["edited"] = True
            texts = all(isinstance(text, str) for texts in book["older"].values() for text in texts)
            if not (texts and all(isinstance(Line(*line).k, int) for line in book["lines"])):
                raise ValueError("it holds something else")
            for question in book["questions"]:
                Known.of(question)
        except DAMAGE as error:
            raise UsageError(
                f"{self.path}: the ledger of audits cannot be read ({error}); expected the JSON that runs write; restore it, "
                "or, if the count of audits may be lost, move it away, and run it again"
            ) from None
        return book

    def _write(self, book: dict[str, Any]) -> None:
        if (seal := _seal(book)) != book["seal"]:
            write_atomic(self.path, json.dumps({**book, "seal": seal}, indent=1).encode())

    def _told(self) -> set[Line]:
        """What run folders beside the book say of it."""
        found = set()
        for path in (p for name in ("certificate.json", "summary.json") for p in self.path.parent.glob(f"*/{name}")):
            with suppress(*DAMAGE):  # a folder may be anybody's
                found.update(_lines(json.loads(path.read_text(encoding="utf-8"))))
        return found


def _question(book: dict[str, Any], asked: Fingerprint) -> dict[str, Any]:
    """What the book has of a question: the first one that is the same, else a new one."""
    known = (q for q in book["questions"] if asked.digest in q["spellings"] or asked.same(Known.of(q)))
    if (found := next(known, None)) is None:
        book["questions"].append(found := {"name": asked.digest, "spellings": [], **asked.known.to_data()})
    if asked.digest not in found["spellings"]:
        found["spellings"].append(asked.digest)
    return found


def _kind(text: str) -> Kind:
    """What a book before format 2 has counted, which counted all kinds as one."""
    return "calibration" if text.startswith(("calibrate:", "recording:")) else "audit"


def _seal(book: dict[str, Any]) -> str:
    """SHA-256 of all that is in it."""
    return json_digest({k: v for k, v in book.items() if k != "seal"})


def _lines(data: Any) -> Iterator[Line]:
    """What a certificate or a summary tells of the book, wherever it does."""
    if isinstance(data, dict):
        if isinstance(book := data.get("book"), dict):
            yield Line(str(book["question"]), str(book["kind"]), int(data["number"]), str(book["audited"]))
        data = list(data.values())
    for part in data if isinstance(data, list) else ():
        yield from _lines(part)
