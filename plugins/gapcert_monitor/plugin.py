"""Declares what this package offers; imports nothing but gapcert."""

from gapcert.plugin import ALLOW_CODE, LOG, RUN, Argument, Component, hookimpl

_NOISE = Argument(
    "--noise",
    "by how much a channel may err, such as theta=1e-4",
    {"action": "append", "default": [], "metavar": "CHANNEL=VALUE"},
)
_QUIET = Argument("--quiet -q", "no progress", {"action": "store_true"})
_AGAIN = Argument(
    "--again", "step so many stored transitions of engine and model once more", {"type": int, "default": 0, "metavar": "N"}
)


@hookimpl
def gapcert_components() -> list[Component]:
    """What looks at a finished certificate again."""
    return [
        Component(
            "command",
            "check",
            "hold a new log against a certificate: does γ still hold?",
            "gapcert_monitor.commands:check",
            arguments=(RUN, LOG, _NOISE, ALLOW_CODE),
        ),
        Component(
            "command",
            "verify",
            "prove a certificate and its controller again from their stored data",
            "gapcert_monitor.commands:verify",
            arguments=(RUN, _AGAIN, ALLOW_CODE, _QUIET),
        ),
    ]
