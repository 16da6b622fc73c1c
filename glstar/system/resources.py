"""Paths of the bundled shaders and data: inside the package in a wheel, beside it in a checkout."""

from importlib.resources import files
from pathlib import Path


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


def manual_pages() -> dict[str, Path]:
    """Return the pages of the manual; returns: markdown files by topic (the file name without ``.md``), sorted."""
    return {page.stem: page for page in sorted(asset("manual").glob("*.md"))}


def shader(name: str) -> str:
    """Return the GLSL source of a shader.

    `name`: file name inside ``shaders/``, such as ``"star.vert"``.  Returns the source text.
    """
    return _inside("shaders", name).read_text(encoding="utf-8")


def shader_paths() -> list[Path]:
    """Return the paths of all shaders; returns: sorted by name."""
    folder = _inside("shaders", "star.vert").parent
    return sorted(path for path in folder.iterdir() if path.suffix in {".vert", ".frag", ".glsl"})
