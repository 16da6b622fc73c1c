"""Values as TOML."""

import tomli_w

__all__ = ["toml_value"]


def toml_value(value: object) -> str:
    """Return a value as TOML, on one line.

    `tomli_w.dumps` has no comments and writes each item of an array on a line of its own; config and calibration files
    have comments beside their values.

    Parameters
    ----------
    value : bool, int, float, str, or list of these
        Infinities and NaN are TOML's ``inf`` and ``nan``.

    Returns
    -------
    str

    Raises
    ------
    TypeError
        If TOML has no such value.
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, float):
        value = float(value)  # NumPy's float64 is a float with another repr
    return tomli_w.dumps({"value": value}).removeprefix("value = ").removesuffix("\n")
