"""One exam: draw, record, diagnose, and write down question and answer; every case by itself, from its seed and index."""

from __future__ import annotations

import signal
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

import gapcert as gc
from exams.hidden.draw import Case
from exams.hidden.laws import Hidden
from exams.hidden.truth import Truth

HORIZONS = (0.5,)
Record = dict[str, Any]


def model(section: Mapping[str, Any]) -> gc.Model:
    known = gc.registry()
    config: Any = known.config("model", section["kind"])
    built: gc.Model = known.build("model", section["kind"], config.model_validate(dict(section)))
    return built


def question(case: Case) -> Record:
    """What was asked, and how hard it is."""
    return {
        "part": case.part,
        "seed": case.seed,
        "index": case.index,
        "plant": case.rig.plant.name,
        "excitation": case.rig.excitation,
        "period": case.rig.period,
        "channels": list(case.noise.sigma),
        "colour": case.noise.colour,
        "dirt": list(case.dirt),
        "engine": case.engine,
        "hold": case.rig.hold if case.told else f"{case.rig.hold}, not told",
        "hidden": [{"effect": h.effect, "site": h.site, "numbers": plain(h.numbers)} for h in case.hidden],
        "label": case.label,
        "strength": round(case.strength, 3),
        "remains": round(case.remains, 3),
        "share": round(case.share, 4),
        "classes": [[list(k) for k in c] for c in case.classes()],
    }


def answer(found: gc.Diagnosis) -> Record:
    """What was said."""
    return {
        "verdict": found.verdict,
        "causes": [
            {
                "effect": c.effect,
                "site": c.site,
                "numbers": {n: e.value for n, e in c.parameters.items()},
                "explained": c.explained,
                "flags": list(c.flags),
            }
            for c in found.causes
        ],
        "ambiguous_with": [[list(k) for k in group] for group in found.ambiguous_with],
        "experiment": None if found.design is None else found.design.name,
        "gain": {h: {n: [g.before, g.after] for n, g in c.items()} for h, c in found.gain.items()},
        "timings": dict(found.timings),
    }


def diagnosed(case: Case, effects: Any = "all", recording: gc.Recording | None = None) -> gc.Diagnosis:
    return gc.diagnose(model(case.model), recording or case.recording(), effects, horizons=HORIZONS)


def timed(act: Any, limit: float) -> Record:
    """The record that `act` makes, with its CPU seconds; an error or a lack of time is an answer too."""

    def late(*_: Any) -> None:
        raise TimeoutError

    start, before = time.process_time(), signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        record: Record = act()
    except TimeoutError:
        record = {"error": f"more than {limit:g} s"}
    except (ImportError, SyntaxError):
        raise
    except Exception as error:  # a crash of the diagnosis is a wrong answer, not the end of the exam
        where = traceback.extract_tb(error.__traceback__)[-1]
        record = {"error": f"{type(error).__name__}: {error} ({where.name}:{where.lineno})"}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
    return record | {"cpu": round(time.process_time() - start, 2)}


def plain(numbers: Mapping[str, float]) -> dict[str, float]:
    return {k: float(v) for k, v in numbers.items()}


def sit(case: Case, limit: float, effects: Any = "all") -> Record:
    recording = case.recording()
    return judged(case, question(case) | timed(lambda: answer(diagnosed(case, effects, recording)), limit))


def judged(case: Case, record: Record) -> Record:
    """With a cause from outside in the class that was missed, where the whole answer fits the noiseless data as well.

    It may have no more effects and numbers than are hidden. The classes are drawn up before, from a screen and a fit or two,
    which may miss a member.
    """
    said = tuple(Hidden(c["effect"], c["site"], c["numbers"]) for c in record.get("causes", []))
    classes = [[*c] for c in record["classes"]]
    missed = [c for c in classes if not any(list(h.key) in c for h in said)]
    strange = [h for h in said if not any(list(h.key) in c for c in classes)]
    numbers, hidden = (sum(len(h.numbers) for h in part) for part in (said, case.hidden))
    if len(missed) != 1 or len(strange) != 1 or len(said) != len(case.hidden) or numbers > hidden:
        return record
    if Truth(case.rig, case.hidden, case.noise.sigma).stands(said):
        missed[0].append(list(strange[0].key))
    return record | {"classes": classes}


def without(keys: Sequence[Sequence[str]]) -> list[str]:
    """The library without some effects, and without everything that contains one of them, or has a form that does."""
    known = gc.registry()
    library = {name: known.build("effect", name) for name in known.names("effect")}
    gone = {k[0] for k in keys}
    inside = {n: {k for form in (e, *e.variants) for k in form.contains} for n, e in library.items()}
    while more := {n for n in library if n not in gone and gone & inside[n]}:
        gone |= more
    return [n for n in library if n not in gone]


def unknown(case: Case, limit: float) -> Record:
    """With everything that could stand for the hidden effect taken out of the library.

    stands: do the effects that were named, together, fit the noiseless data as well as the truth does, within the noise?
    """
    asked = question(case)
    recording, rest = case.recording(), without(asked["classes"][0])
    record = asked | {"library": len(rest)} | timed(lambda: answer(diagnosed(case, rest, recording)), limit)
    said = tuple(Hidden(c["effect"], c["site"], c["numbers"]) for c in record.get("causes", []))
    return record | {"stands": bool(said) and Truth(case.rig, case.hidden, case.noise.sigma).stands(said)}
