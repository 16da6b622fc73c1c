"""The command that installs optional dependencies, for messages."""

import json
import platform
import shlex
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import glstar

# What a Linux system without OpenGL or X11 lacks.
OPENGL_ON_LINUX = "Debian and Ubuntu: sudo apt-get install libgl1 libegl1"
# Libraries whose versions matter in a report of a problem.
_LIBRARIES = (
    "moderngl",
    "glcontext",
    "numpy",
    "glfw",
    "imgui-bundle",
    "opencv-contrib-python-headless",
    "pyerfa",
    "pymavlink",
    "pydantic",
    "typer",
    "rich",
    "tifffile",
)
# Packages of the window without a wheel for macOS before this version.
_MACOS_14 = {"imgui-bundle"}


def library_versions() -> dict[str, str | None]:
    """Return the versions, by name, of the libraries that glstar needs; None for one that is not installed."""
    versions: dict[str, str | None] = {}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return versions


def install_command(extra: str = "") -> str:
    """Return the command that installs glstar with an extra, from the same source as the current installation.

    `extra`: an extra of ``pyproject.toml``, such as ``"solve"``, or empty.  Returns a command for a POSIX shell: ``pip
    install -e '/home/me/glstar[solve]'`` for a checkout, ``pip install 'glstar[solve]'`` for a package index.  If the
    source no longer exists, the command installs the requirements of the extra.  pip records the source of packages
    that it installs from a path or URL in ``direct_url.json`` (PEP 610).
    """
    wanted = f"[{extra}]" if extra else ""
    try:
        installed = distribution("glstar")
    except PackageNotFoundError:
        return _from_checkout(wanted) or f"pip install {shlex.quote(f'glstar{wanted}')}"
    origin = _origin(installed)
    if origin is None:
        return _from_checkout(wanted) or f"pip install {shlex.quote(f'glstar{wanted}')}"
    url = str(origin.get("url", ""))
    if "vcs_info" in origin:
        version = origin["vcs_info"]
        return _install(f"glstar{wanted} @ {version.get('vcs', 'git')}+{url}@{version.get('commit_id', '')}")
    if not url.startswith("file:"):
        return _install(f"glstar{wanted} @ {url}")
    path = Path(url2pathname(urlsplit(url).path))
    if not path.exists():
        return " ".join(["pip install", *map(shlex.quote, _requirements(installed, extra))])
    is_editable = origin.get("dir_info", {}).get("editable", False)
    return _install(f"{path}{wanted}", "-e" if is_editable else "")


def missing_library(name: str) -> str:
    """Return a message about a required package, such as ``"imgui-bundle"``, that is not installed, with the remedy."""
    major = platform.mac_ver()[0].partition(".")[0] if sys.platform == "darwin" else ""
    if name in _MACOS_14 and major.isdigit() and int(major) < 14:
        return f"{name} is not installed: it has no wheel for macOS {major}, but for macOS 14 and newer"
    return f"{name} is not installed: {install_command()}"


def _install(requirement: str, option: str = "") -> str:
    return " ".join(part for part in ("pip install", option, shlex.quote(requirement)) if part)


def _from_checkout(wanted: str) -> str:
    """Return the command for a checkout that was not installed by pip; empty if this is no checkout."""
    root = Path(glstar.__file__).parent.parent
    return _install(f"{root}{wanted}", "-e") if (root / "pyproject.toml").is_file() else ""


def _origin(installed: Distribution) -> dict[str, Any] | None:
    """Return the content of ``direct_url.json``; None if there is none."""
    try:
        origin = json.loads(installed.read_text("direct_url.json") or "null")
    except ValueError:
        return None
    return origin if isinstance(origin, dict) else None


def _requirements(installed: Distribution, extra: str) -> list[str]:
    """Return the requirements of an extra, as arguments of pip."""
    marker = f'extra == "{extra}"'
    requirements = [requirement.split(";") for requirement in installed.requires or ()]
    names = [name.strip() for name, *marks in requirements if marker in "".join(marks).replace("'", '"')]
    return names or [f"glstar[{extra}]"]
