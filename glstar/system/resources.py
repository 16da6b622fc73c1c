"""Paths of the bundled shaders and data: inside the package in a wheel, beside it in a checkout."""

from functools import cache
from importlib.resources import files
from os import PathLike
from pathlib import Path

# Name of the bundled flight, in place of the path of a log.
DEMO = "demo"

# The pages of the manual by kind, as Diataxis divides documentation; within a kind in the order of a first reading.
MANUAL_KINDS: dict[str, tuple[str, ...]] = {
    "How-to: one task a page": (
        *("tutorial", "installation", "problems", "mounts", "export", "learning", "viewer", "live", "fly"),
        *("calibration", "comparison", "navigator", "score", "celestialfix", "python", "extending"),
    ),
    "Reference: every flag, key, format and word": (
        *("commandline", "config", "truth", "logs", "conventions", "solvers", "bench", "glossary"),
    ),
    "Background: the models, with their measurements": (
        *("sky", "sensor", "imaging", "rolling-shutter", "twins", "accuracy", "performance", "reliability"),
        *("experiments", "paper", "surprises", "architecture"),
    ),
}


@cache
def _inside(folder: str, name: str) -> Path:
    """Return a file of `glstar.<folder>`; in an editable install the folder is at the root of the checkout."""
    try:
        return Path(str(files(f"glstar.{folder}").joinpath(name)))
    except ModuleNotFoundError:
        return Path(__file__).parents[2] / folder / name


def asset(name: str) -> Path:
    """Return the path of a bundled data file.

    Parameters
    ----------
    name : str
        File name inside ``assets/``, such as ``"bsc5.sqlite"``.

    Returns
    -------
    pathlib.Path
        The file.
    """
    return _inside("assets", name)


def bundled_flight() -> Path:
    """Return the log of the bundled flight over Adelaide."""
    return asset("adelaide.BIN")


def flight_path(name: str | PathLike[str]) -> Path:
    """Return the path of a flight: of the bundled one if it is called ``demo``, and no file is."""
    path = Path(name)
    return bundled_flight() if str(path) == DEMO and not path.exists() else path


def manual_pages() -> dict[str, Path]:
    """Return the Markdown files of the manual, sorted, by topic: the file name without ``.md``."""
    return {page.stem: page for page in sorted(asset("manual").glob("*.md"))}


@cache
def shader(name: str) -> str:
    """Return the GLSL source of a shader by its file name, such as ``"star.vert"``; it is read once."""
    return _inside("shaders", name).read_text(encoding="utf-8")


def shader_paths() -> list[Path]:
    """Return the paths of all shaders, sorted by name."""
    folder = _inside("shaders", "star.vert").parent
    return sorted(path for path in folder.iterdir() if path.suffix in {".vert", ".frag", ".glsl"})
