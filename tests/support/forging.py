"""Saved certificates changed as a forger would change them: with the digests mended."""

import hashlib
import json

import numpy as np

from gapcert_verify.verify import verify_run


def edit_json(run, **changes):
    """Entries of certificate.json by path, parts joined by `__`; a callable gets the entry as it is."""
    data = json.loads((run / "certificate.json").read_text())
    for path, value in changes.items():
        node = data
        *parents, last = path.split("__")
        for p in parents:
            node = node[p]
        node[last] = value(node[last]) if callable(value) else value
    (run / "certificate.json").write_text(json.dumps(data))


def edit_arrays(run, **changes):
    """Arrays of certificate.npz by name, dots written as `__`, through a function of what they are."""
    with np.load(run / "certificate.npz") as stored:
        arrays = dict(stored)
    for name, change in changes.items():
        key = name.replace("__", ".")
        arrays[key] = change(arrays[key])
    np.savez(run / "certificate.npz", **arrays)
    edit_json(run, arrays=hashlib.sha256((run / "certificate.npz").read_bytes()).hexdigest())


def failed(run):
    """The checks of `gapcert verify` that do not pass."""
    return [c["check"] for c in verify_run(run)["checks"] if not c["passed"]]
