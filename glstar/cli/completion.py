"""Completion of values in the shell: presets, maps of columns, sensors, and pages of the manual."""

from glstar.system.resources import manual_pages

__all__ = ["camera_names", "column_maps", "manual_topics", "sensor_names"]


def camera_names(incomplete: str) -> list[str]:
    """Return the presets of ``--camera`` that begin with a word.

    Parameters
    ----------
    incomplete : str

    Returns
    -------
    list of str
        Cameras, and modes of sensors such as ``imx477:2028x1520``.
    """
    from glstar.camera.presets import camera_presets  # noqa: PLC0415 - read only where the shell asks
    from glstar.camera.sensorpresets import sensor_presets  # noqa: PLC0415

    modes = [mode.name for preset in sensor_presets().values() for mode in preset.modes]
    return _matching(incomplete, [*camera_presets(), *modes])


def sensor_names(incomplete: str) -> list[str]:
    """Return the sensors that begin with a word.

    Parameters
    ----------
    incomplete : str

    Returns
    -------
    list of str
    """
    from glstar.camera.sensorpresets import sensor_presets  # noqa: PLC0415

    return _matching(incomplete, list(sensor_presets()))


def column_maps(incomplete: str) -> list[str]:
    """Return the maps of ``--columns`` that begin with a word.

    Parameters
    ----------
    incomplete : str

    Returns
    -------
    list of str
    """
    from glstar.telemetry.columnmap import ready_maps  # noqa: PLC0415

    return _matching(incomplete, list(ready_maps()))


def manual_topics(incomplete: str) -> list[str]:
    """Return the pages of the manual that begin with a word.

    Parameters
    ----------
    incomplete : str

    Returns
    -------
    list of str
    """
    return _matching(incomplete, list(manual_pages()))


def _matching(incomplete: str, names: list[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]
