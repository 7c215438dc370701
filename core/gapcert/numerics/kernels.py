"""Functions that Numba compiles: by one decorator, which keeps them per user, from one process to the next.

What is kept is machine code, read through pickle. A stale one must never be taken for a fresh one: a folder goes by the text of
all modules beside the function (what it calls is from there, and constants that are compiled in) and by the versions, a file in
it by the function, its options, its signature and the processor. And nobody else may plant one: only folders and files are read
that belong to this user and that no one else can write.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import importlib.util
import os
import pickle
import platform
import shutil
import stat
import sys
import uuid
import warnings
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast, final

from gapcert.thresholds import THRESHOLDS

F = TypeVar("F", bound=Callable[..., Any])

LISTENERS: list[Callable[[str], None]] = []
"""Who is told, in a sentence, that something has to be compiled."""


def compiler(**options: Any) -> Callable[[F], F]:
    """A decorator: `numba.njit` with these options, and what it compiles kept; without Numba the function as it is."""
    if importlib.util.find_spec("numba") is None:
        return lambda function: function
    import numba

    njit: Any = numba.njit

    def decorated(function: F) -> F:
        made = njit(no_cfunc_wrapper=True, **options)(function)  # no C code calls it
        if function.__closure__ is None:  # what a closure holds is no part of any text
            made._cache = _Kept(function, options)
        made.get_call_template = _by_types(made.get_call_template)
        return cast(F, made)

    return decorated


def _by_types(template: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Called by another kernel with a number that stands in its text, one would be compiled for that number alone."""
    from numba.core import errors, types

    plain: Any = types.unliteral

    def found(given: Any, named: Any) -> Any:
        try:
            return template(tuple(map(plain, given)), {name: plain(of) for name, of in named.items()})
        except errors.ForceLiteralArg:  # it asks for the number, by `numba.literally`
            return template(given, named)

    return found


@final
class _Kept:
    """What Numba asks for compiled code before it compiles, and gives it to after."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        source = Path(function.__code__.co_filename)
        alone = not getattr(sys.modules.get(function.__module__), "__package__", "")
        top = getattr(sys.modules.get(function.__module__.partition(".")[0]), "__file__", None)
        package = source.parent if alone or top is None else Path(top).parent
        # Read while the module is imported: later its text may be another than what runs.
        self._place = package.name, _text(source if alone else package)
        self.cache_path = "-".join(self._place)
        self._name = function.__module__, function.__qualname__, function.__code__.co_firstlineno, sorted(options.items())

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What was compiled before for this signature and processor, or None."""
        from numba.core import compiler

        target.refresh()
        if (payload := self._read(self._key(signature, target.codegen()))) is None:
            while LISTENERS:
                LISTENERS.pop()(f"compiling for this machine, some seconds{'' if self._folder is None else ', once'} ...")
            return None
        rebuilt: Any = compiler.CompileResult
        return rebuilt._rebuild(target, *payload)

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep it for the next process, if that can be."""
        if self._folder is None or result.library.has_dynamic_globals:
            return
        from numba.core import serialize

        numba: Any = serialize
        key = self._key(signature, result.library.codegen)
        body: bytes = numba.dumps((key, result._reduce()))
        with suppress(OSError):  # no room, or no folder any more: it is compiled again
            _write(self._folder, _named(key), hashlib.sha256(body).digest() + body)

    @property
    def _folder(self) -> int | None:
        return _folder(os.environ.get("XDG_CACHE_HOME", ""), *self._place)

    def _key(self, signature: Any, codegen: Any) -> str:
        return repr((*self._name, str(signature), codegen.magic_tuple()))

    def _read(self, key: str) -> Any:
        if self._folder is None:
            return None
        try:
            with os.fdopen(os.open(_named(key), os.O_RDONLY | os.O_NOFOLLOW, dir_fd=self._folder), "rb") as file:
                _owned(file.fileno(), _named(key))
                data = file.read()
        except OSError:
            return None
        # Half a file, or one of a disk that fails, is compiled again.
        if hashlib.sha256(data[32:]).digest() != data[:32]:
            return None
        known, payload = pickle.loads(data[32:])
        return payload if known == key else None


def _text(source: Path) -> str:
    """A digest of the text of a file, or of all modules in a folder, and of the versions; empty where none can be read."""
    paths = [source] if source.is_file() else sorted(Path(at, n) for at, _, names in os.walk(source) for n in names)
    parts = [(path, os.stat(path)) for path in paths if path.suffix == ".py"]
    # A module may be imported again, with another text, by the same process.
    return _digest(source, tuple((path, found.st_mtime_ns, found.st_size) for path, found in parts)) if parts else ""


@functools.cache
def _digest(source: Path, parts: tuple[tuple[Path, int, int], ...]) -> str:
    import numba
    import numpy as np

    versions = sys.version, platform.machine(), np.__version__, numba.__version__, version("llvmlite")
    digest = hashlib.sha256(repr(versions).encode())
    for path, _, _ in parts:
        text = path.read_bytes()
        digest.update(f"{path.relative_to(source)} {len(text)} ".encode() + text)
    return digest.hexdigest()[:24]


@functools.cache
def _folder(home: str, package: str, text: str) -> int | None:
    """The open folder of a package and its text; None, and a warning, where nothing can be kept."""
    if not text:
        return None
    try:
        top = Path(home or Path.home() / ".cache")
        top.mkdir(mode=0o700, parents=True, exist_ok=True)
        parent, names = os.open(top, os.O_RDONLY | os.O_DIRECTORY), ("gapcert", "kernels", f"{package}-{text}")
        for name in names:
            try:
                with suppress(FileExistsError):
                    os.mkdir(name, 0o700, dir_fd=parent)
                folder = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=parent)
                _owned(folder, name)
                if name is names[-1]:
                    _prune(parent, folder, package)
            finally:
                os.close(parent)
            parent = folder
    except (OSError, RuntimeError) as error:  # RuntimeError: this user has no home
        _warn(error)
        return None
    return folder


def _owned(descriptor: int, name: str) -> None:
    """PermissionError where somebody else could have put it there."""
    found = os.fstat(descriptor)
    if found.st_uid != os.geteuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(errno.EPERM, "belongs to somebody else, or others can write it", name)


def _prune(parent: int, folder: int, package: str) -> None:
    """The folders of a package that were not used for longest go; this one is used now."""
    with suppress(OSError):
        os.utime(folder)
        found = [name for name in os.listdir(parent) if name.rpartition("-")[0] == package]
        found.sort(key=lambda name: os.stat(name, dir_fd=parent).st_mtime)
        for name in found[: -THRESHOLDS.kept_folders]:
            shutil.rmtree(name, ignore_errors=True, dir_fd=parent)


def _named(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:40]


def _write(folder: int, name: str, data: bytes) -> None:
    """The whole file or none of it, whoever writes it at the same time."""
    part = f"{name}.{uuid.uuid4().hex}"
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600, dir_fd=folder), "wb") as file:
        try:
            file.write(data)
            file.flush()
            os.replace(part, name, src_dir_fd=folder, dst_dir_fd=folder)
        except OSError:
            os.unlink(part, dir_fd=folder)
            raise


def _warn(error: Exception) -> None:
    """One sentence, of this process and not of each of its workers."""
    from multiprocessing import parent_process

    if parent_process() is None:
        what = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
        hint = "let XDG_CACHE_HOME name a folder that is yours alone"
        text = f"what is compiled cannot be kept and is compiled in every run ({what}); {hint}"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
