"""``[output]``: the tone curve, which may be a list of points or a file."""

from pathlib import Path
from typing import Any

from glstar.camera.tonecurve import checked_points, curve_text, is_curve_text, parse_curve, read_curve

__all__ = ["checked_output"]


def checked_output(values: dict[str, Any], folder: Path, faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the values of ``[output]`` with the points of the tone curve as text.

    Parameters
    ----------
    values : dict of str to object
        The section, each key checked on its own.
    folder : Path
        The folder that the path of a curve is relative to.
    faults : list of (key, message)
        Errors are appended.

    Returns
    -------
    dict of str to object
    """
    given = values["tone_curve"]
    if not given:
        return {**values, "tone_curve": ""}
    if values["gamma"] != "linear":
        faults.append(("output.tone_curve", "is a tone curve, and so is gamma; leave one out"))
        return values
    try:
        if not isinstance(given, str):
            points = checked_points(given)
        else:
            points = parse_curve(given) if is_curve_text(given) else read_curve((folder / given).absolute())
    except ValueError as error:
        faults.append(("output.tone_curve", str(error)))
        return values
    return {**values, "tone_curve": curve_text(points)}
