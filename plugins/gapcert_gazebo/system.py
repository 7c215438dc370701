"""What the operating system must offer: a compiler, and Gazebo's libraries as pkg-config knows them."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess

COMPILER = "g++"
MODULES = {
    "eigen3": "libeigen3-dev",
    "ignition-physics5": "libignition-physics-core-dev",
    "ignition-physics5-sdf": "libignition-physics-sdf-dev",
    "ignition-plugin1-loader": "libignition-plugin-dev",
    "sdformat12": "libsdformat-dev",
}
"""Modules of pkg-config, and the Debian package of each."""
ENGINE = "ign-physics-5/engine-plugins/libignition-physics5-dartsim-plugin.so.5", "libignition-physics5-dartsim-plugin5"
"""What Gazebo loads at run time, beside its libraries, and its Debian package."""


def absent() -> list[str]:
    """Debian packages that are missing here."""
    missing = [program for program in (COMPILER, "pkg-config") if shutil.which(program) is None]
    if "pkg-config" in missing:
        return missing
    # One call answers for all of them where nothing is missing.
    if not _knows(*MODULES):
        missing += [package for module, package in MODULES.items() if not _knows(module)]
    if not os.path.exists(os.path.join(pkg_config("--variable=libdir", "ignition-physics5").strip(), ENGINE[0])):
        missing.append(ENGINE[1])
    return missing


def flags() -> list[str]:
    """Options of the compiler and the linker."""
    return shlex.split(pkg_config("--cflags", "--libs", *MODULES))


def versions() -> list[str]:
    return pkg_config("--modversion", *MODULES).split()


def pkg_config(*arguments: str) -> str:
    return subprocess.run(["pkg-config", *arguments], capture_output=True, text=True, check=False).stdout


def _knows(*modules: str) -> bool:
    return subprocess.run(["pkg-config", "--exists", *modules], check=False).returncode == 0
