"""The C++ shim: compiled on first use, kept beside other caches, called through ctypes."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import json
import os
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from gapcert import UsageError

from .system import COMPILER, flags, versions

SOURCES = [Path(__file__).with_name(name) for name in ("shim.cpp", "robot.hh", "links.hh")]
_OPTIONS = ["-O2", "-fPIC", "-shared"]
_HANDLE, _ARRAY, _TEXT, _LONG = ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int64
_SIGNATURES = {
    "failure": (_TEXT, []),
    "open": (_HANDLE, [_TEXT] * 4 + [_LONG]),
    "close": (None, [_HANDLE]),
    "describe": (_TEXT, [_HANDLE]),
    "set": (ctypes.c_int, [_HANDLE, _ARRAY]),
    "drive": (ctypes.c_int, [_HANDLE, ctypes.c_int, *[_ARRAY] * 3, *[ctypes.c_double] * 2, ctypes.c_int]),
    "advance": (ctypes.c_int, [_HANDLE, _LONG, *[ctypes.c_int] * 2, *[_ARRAY] * 6]),
    "poses": (ctypes.c_int, [_HANDLE, _LONG, *[_ARRAY] * 3]),
    "bare": (None, [_HANDLE, _LONG, ctypes.c_int, *[_ARRAY] * 3]),
}


@functools.cache
def shim() -> Any:
    """The loaded library; its functions have the names of the C interface without their prefix."""
    path = str(compiled())
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        raise UsageError(f"gazebo: {path} cannot be loaded: {error}; delete it, it is compiled again") from None

    class Functions:
        pass

    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, f"gapcert_{name}")
        function.restype, function.argtypes = result, arguments
        setattr(Functions, name, staticmethod(function))
    return Functions


def compiled() -> Path:
    """The compiled shim of these sources, compiler and libraries; compiles it (half a minute) where there is none."""
    options = [*_OPTIONS, *flags()]
    compiler = subprocess.run([COMPILER, "--version"], capture_output=True, text=True, check=False).stdout
    parts = [[p.read_text() for p in SOURCES], compiler, options, versions()]
    digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:24]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gapcert/gazebo"
    path = folder / f"{digest}.so"
    if path.exists():
        return path
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            made = Path(work) / path.name
            command = [COMPILER, *_OPTIONS, "-o", str(made), str(SOURCES[0]), *flags()]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                problem = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[-200:])
                raise UsageError(
                    f"gazebo: {COMPILER} cannot compile the shim: {problem}; reinstall the packages that `gapcert doctor` names"
                )
            # Whoever comes second replaces the same bytes, and never finds half of a file.
            made.replace(path)
    except OSError as error:
        raise UsageError(
            f"gazebo: {folder} cannot be written: {error.strerror}; let XDG_CACHE_HOME name a folder that can"
        ) from None
    return path


def failure() -> str:
    """What went wrong last in this thread, as one line."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", shim().failure().decode(errors="replace"))
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())
