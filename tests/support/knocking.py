"""A package of somebody else: a study of five lines, one after a certificate, a plain section, a command; and what is wrong
with others.
"""

import numpy as np

from gapcert.plugin import Answer, Argument, Component, Outcome, Section, SpecSection, Study


class Knock(Section):
    """How often, and on what."""

    times: int
    on: str = "wood"


class KnockSection(SpecSection):
    model = Knock
    about = "knocks, and what they are on"
    needs = ("model",)
    alone = True


class KnockStudy(Study):
    def run(self, build, folder, stages, made):
        asked = build.spec.config.sections["knock"]
        return Outcome({"verdict": "knocked", "reason": f"{asked.times} times on {asked.on}"}, {"knocks": asked.times})


class Along(Section):
    """The largest γ from one corner of the domain to the other, at so many points."""

    points: int = 11


class AlongSection(SpecSection):
    model = Along
    about = "the largest γ along the diagonal"
    needs = ("certificate",)


class AlongStudy(Study):
    def run(self, build, folder, stages, made):
        domain, asked = made.artifacts["domain"], build.spec.config.sections["along"]
        gamma = made.artifacts["certificate"].gap.gamma(np.linspace(domain.low, domain.high, asked.points))
        return Outcome({"along": {"largest": float(gamma.max())}})


class NoteSection(SpecSection):
    """Says something beside a certificate, and asks for nothing."""

    model = type("Note", (Section,), {"__annotations__": {"text": str}})
    about = "a remark"


def hello(options):
    return Answer({"hello": options.name}, [f"hello, {options.name}"])


def components():
    return [
        Component("study", "knock", "knocks", f"{__name__}:KnockStudy", f"{__name__}:KnockSection"),
        Component("study", "along", "γ along the diagonal", f"{__name__}:AlongStudy", f"{__name__}:AlongSection"),
        Component("section", "note", "a remark", f"{__name__}:NoteSection"),
        Component("command", "hello", "greet somebody", f"{__name__}:hello", arguments=(Argument("NAME", "whom"),)),
    ]


def wrong():
    return [
        Component("section", "gone", "no module", "no_such_module:Gone", distribution="acme 1.0"),
        Component("section", "domain", "another domain", f"{__name__}:NoteSection", distribution="acme 1.0"),
        Component("command", "run", "another run", f"{__name__}:hello", distribution="acme 1.0"),
        Component("command", "nowhere inner", "below nothing", f"{__name__}:hello", distribution="acme 1.0"),
    ]
