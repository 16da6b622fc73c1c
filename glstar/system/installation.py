"""The command that installs optional dependencies, for messages."""

import json
import platform
import shlex
import sys
from importlib import import_module
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions, version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import glstar

# What a Linux system without OpenGL or X11 lacks.
OPENGL_ON_LINUX = "Debian and Ubuntu: sudo apt-get install libgl1 libegl1"
# Libraries whose versions matter in a report of a problem, with the module of each and a function that must be in it.
_OPENCV = "opencv-contrib-python-headless"
_LIBRARIES = {
    "moderngl": ("moderngl", "create_context"),
    "glcontext": ("glcontext", "get_backend_by_name"),
    "numpy": ("numpy", "einsum"),
    "glfw": ("glfw", "init"),
    "imgui-bundle": ("imgui_bundle.imgui", "begin"),
    _OPENCV: ("cv2", "imencode"),
    "pyerfa": ("erfa", "pnm06a"),
    "pymavlink": ("pymavlink.dialects.v20.common", "MAVLink"),
    "pydantic": ("pydantic", "BaseModel"),
    "typer": ("typer", "Typer"),
    "rich": ("rich.console", "Console"),
    "tifffile": ("tifffile", "imwrite"),
}
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


def broken_libraries() -> list[str]:
    """Return a message, with the remedy, about each library that is installed and does not run."""
    messages = []
    for name, found in library_versions().items():
        module, function = _LIBRARIES[name]
        error = None if found is None else _error_of(module, function)
        if error is not None:
            again = f"pip install --force-reinstall --no-deps {name}"
            messages.append(f"{name} {found} is installed and does not run ({error}): {again}")
    others = sorted(set(packages_distributions().get("cv2", ())) - {_OPENCV})
    if others:
        again = f"pip uninstall {' '.join(others)} && pip install --force-reinstall --no-deps {_OPENCV}"
        messages.append(
            f"{' and '.join(others)} writes to the folder of {_OPENCV} too, so that removing or upgrading one breaks"
            f" the other; to keep only one: {again}"
        )
    return messages


def _error_of(module: str, function: str) -> str | None:
    """Return why a function of a module cannot be used; None if it can."""
    try:
        getattr(import_module(module), function)
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())}"
    return None


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
