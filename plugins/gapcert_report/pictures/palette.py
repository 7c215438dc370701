"""The colours of a report: variables of its style sheet, for which pictures are drawn with stand-ins."""

from __future__ import annotations

# No colour map produces these; each becomes a CSS variable, so that dark mode and print choose their own.
INK, FAINT, WITH, WITHOUT, TRUTH, BAD, GOOD = "#111213", "#717273", "#2f6fd1", "#d9670b", "#111214", "#c81e32", "#15803e"
CARD = "#fdfcfb"
_VARIABLES = {
    INK: "ink", FAINT: "faint", WITH: "with", WITHOUT: "without", TRUTH: "truth", BAD: "bad", GOOD: "good", CARD: "card",
}  # fmt: skip
ROLES = {
    "with γ": WITH, "without γ": WITHOUT, "measured": TRUTH, "before": WITHOUT, "after": WITH,
    "stay": INK, "avoid": BAD, "target": GOOD, "region": GOOD,
    # Inside bitmaps, so readable on light and dark alike.
    "both": "#4a86dc", "only_with_gamma": "#23b5a8", "only_without_gamma": "#e8833a",
}  # fmt: skip
"""What figures name, in its colour."""


def variables(text: str) -> str:
    """A text in which each stand-in is the variable that it stands for."""
    for stand_in, name in _VARIABLES.items():
        text = text.replace(stand_in, f"var(--{name})")
    return text
