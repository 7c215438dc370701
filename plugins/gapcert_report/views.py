"""How results are shown: the components of kind `view`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, final

from gapcert.plugin import View

from . import notebook
from .words import diagnosis as diagnosis_words
from .words import summary as summary_words


@final
class CertificateView(View):
    """Of a Certificate, or a Declaration."""

    def line(self, value: Any) -> str:
        return notebook.certificate_line(value.summary(), type(value).__name__)

    def html(self, value: Any) -> str:
        return notebook.certificate_html(value.summary())


@final
class RecordingView(View):
    """Of a certificate on a recording, with the scores of its windows."""

    def line(self, value: Any) -> str:
        return notebook.certificate_line(value.summary(), type(value).__name__)

    def html(self, value: Any) -> str:
        return notebook.recording_html(value)


@final
class DiagnosisView(View):
    """Of a Diagnosis."""

    def line(self, value: Any) -> str:
        return notebook.diagnosis_line(value)

    def sentence(self, value: Any) -> str:
        return diagnosis_words.sentence(value.summary())

    def html(self, value: Any) -> str:
        return notebook.diagnosis_html(value)


@final
class ComparisonView(View):
    """Of a Comparison."""

    def line(self, value: Any) -> str:
        return notebook.comparison_line(value.summary)

    def html(self, value: Any) -> str:
        return notebook.comparison_html(value)


@final
class RunView(View):
    """Of a Run."""

    def line(self, value: Any) -> str:
        return notebook.run_line(value.folder, value.summary, [r.summary for r in value.runs])

    def lines(self, summary: Mapping[str, Any]) -> Iterator[str]:
        return summary_words.in_words(summary)

    def html(self, value: Any) -> str:
        return notebook.run_html(value.folder, value.summary, [r.summary for r in value.runs])
