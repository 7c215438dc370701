"""Declares what this package offers; imports nothing but gapcert."""

from pathlib import Path

from gapcert.plugin import ALLOW_CODE, LOG, RUN, Argument, Component, hookimpl

_VIEWS = {
    "Certificate": ("Certificate", "a certificate in a line and in a notebook"),
    "Declaration": ("Certificate", "a declared gap in a line and in a notebook"),
    "CalibratedRecording": ("Recording", "a recording's certificate, likewise"),
    "Diagnosis": ("Diagnosis", "a diagnosis, and its sentence"),
    "Comparison": ("Comparison", "a comparison in a line and in a notebook"),
    "Run": ("Run", "a run, and what a terminal says of it"),
}


@hookimpl
def gapcert_components() -> list[Component]:
    """Pages, pictures and words."""
    return [
        Component("illustrator", "figures", "figures of what stages have found", "gapcert_report.illustrator:Illustrator"),
        Component("report", "html", "a run folder as one page", "gapcert_report.pages.page:write_report"),
        Component(
            "command",
            "inspect",
            "show what is in a log: rates, gaps, ranges, noise; of a spec, what it could show; with a page of plots",
            "gapcert_report.commands:inspect",
            arguments=(
                LOG,
                Argument("--out", "where the page goes (runs)", {"type": Path, "default": Path("runs"), "metavar": "DIR"}),
                ALLOW_CODE,
            ),
        ),
        Component(
            "command", "report", "write the HTML report of a run again", "gapcert_report.commands:report", arguments=(RUN,)
        ),
        *(Component("view", name, text, f"gapcert_report.notebook:{view}View") for name, (view, text) in _VIEWS.items()),
    ]
