"""The book: which audits each question has had, in one JSON file beside the run folders."""

from __future__ import annotations

import fcntl
import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from gapcert.certification.fingerprint import Fingerprint
from gapcert.numerics.atomic_files import DAMAGE, write_atomic
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError
from gapcert.numerics.order_statistics import drawing

FORMAT = 2
Kind = Literal["audit", "calibration", "closed loop", "hidden state"]
"""What is counted apart, each against its own β."""
Line = tuple[str, str, int, str]
"""Of the book: question, kind, k, and the digest of what was audited."""


@final
@dataclass(frozen=True)
class Entry:
    """Audit k of a question, by its name, and kind: it may spend β_k = β / 2^k, so that all together spend at most β.

    Without a question it is one of a book before format 2. lost: audits that run folders tell of and the book does not; edited:
    it was changed by other hands.
    """

    k: int
    kind: Kind = "audit"
    question: str = ""
    audited: str = ""
    lost: int = 0
    edited: bool = False

    def draws(self, seed: int, stream: str) -> np.random.Generator:
        """What its points are drawn from."""
        return drawing(seed, self.k, stream, self.question, self.audited)

    def summary(self) -> dict[str, Any]:
        """`number`, and in `book` what the book knows it by."""
        own: dict[str, Any] = {"number": self.k, "kind": self.kind, "question": self.question, "audited": self.audited}
        damage = {k: v for k, v in (("lost", self.lost), ("edited", self.edited)) if v}
        return {"number": self.k} | ({"book": own | damage} if self.question else {})

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the book, or with what it has of this audit."""
        if not self.question:
            return [f"audit {self.k} is of a book before format {FORMAT}, whose rule of drawing lets a fit know its points"]
        lost = f"lacks {self.lost} that run folders beside it tell of, so that it was lost or replaced" if self.lost else ""
        told = " and ".join(filter(None, (lost, "was edited" if self.edited else "")))
        return [f"the book of audits {told}; what nothing else tells of is not counted"] if told else []


@final
@dataclass(frozen=True)
class Ledger:
    """An entry is written before anything is drawn: an audit that was begun counts. The same again is the same audit."""

    path: Path

    def enter(self, asked: Fingerprint, kind: Kind, audited: str) -> Entry:
        """The entry of what the text `audited` tells from all else; a new one is recorded under an exclusive lock."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # Opened as it is: a lock has no content to be truncated, wherever a link may lead.
        with open(self.path.with_suffix(".lock"), "a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return self._entered(self._book(), asked, kind, audited)

    def _entered(self, book: dict[str, Any], asked: Fingerprint, kind: Kind, audited: str) -> Entry:
        older, questions, lines = book["older"], book["questions"], {tuple(line) for line in book["lines"]}
        if audited in (before := older.get(asked.digest, [])):
            return Entry(before.index(audited) + 1, kind)
        known = next((q for q in questions if asked.digest in q["spellings"] or asked.same(q)), None)
        if known is None:
            plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asked.known.items()}
            questions.append(known := {"name": asked.digest, "spellings": [], **plain})
        if asked.digest not in known["spellings"]:
            known["spellings"].append(asked.digest)
        lost = self._told() - lines
        # A name that is not in the book may be that of any question, and so of this one.
        others = {q["name"] for q in questions} - {known["name"]}
        own = {line[3]: line[2] for line in lines | lost if line[1] == kind and line[0] not in others}
        was = [
            text.startswith(("calibrate:", "recording:")) for spelling in known["spellings"] for text in older.get(spelling, [])
        ]
        digest = hashlib.sha256(audited.encode()).hexdigest()
        if (k := own.get(digest)) is None:
            k = 1 + max([was.count(kind == "calibration"), *own.values()])
            book["lines"].append([known["name"], kind, k, digest])
        if (seal := _seal(book)) != book["seal"]:
            write_atomic(self.path, json.dumps({**book, "seal": seal}).encode())
        return Entry(k, kind, known["name"], digest, len(lost), book["edited"])

    def _book(self) -> dict[str, Any]:
        """What has been counted. A book that cannot be read is never begun anew: that would spend β twice."""
        new = {"format": FORMAT, "questions": [], "lines": [], "older": {}, "edited": False, "seal": ""}
        if not self.path.exists():
            return new
        try:
            found = json.loads(self.path.read_text(encoding="utf-8"))
            book: dict[str, Any] = found if "format" in found else {**new, "older": found}
            texts = all(isinstance(text, str) for before in book["older"].values() for text in before)
            if book["format"] != FORMAT or book.keys() != new.keys() or not texts:
                raise ValueError("it holds something else")
        except DAMAGE as error:
            raise UsageError(
                f"{self.path}: the ledger of audits cannot be read ({error}); expected the JSON that runs write; restore it, "
                "or, if the count of audits may be lost, move it away, and run it again"
            ) from None
        return {**book, "edited": book["edited"] or book["seal"] not in ("", _seal(book))}

    def _told(self) -> set[Line]:
        """What run folders beside the book tell of it."""
        told = set[Line]()

        def noted(part: dict[str, Any]) -> dict[str, Any]:
            if {"question", "audited"} <= part.keys():
                told.add((str(part["question"]), str(part["kind"]), int(part["number"]), str(part["audited"])))
            return part

        for path in (p for name in ("certificate", "summary") for p in self.path.parent.glob(f"*/{name}.json")):
            with suppress(*DAMAGE):  # a folder may be anybody's
                json.loads(path.read_text(encoding="utf-8"), object_hook=noted)
        return told


def _seal(book: dict[str, Any]) -> str:
    """SHA-256 of all that is in it."""
    return json_digest({k: v for k, v in book.items() if k != "seal"})
