"""Completion of values in the shell: presets, maps of columns, sensors, and pages of the manual."""

from collections.abc import Callable, Iterable

from glstar.system.resources import manual_pages


def _completion(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a function that lists the names that begin with a word; they are read only where the shell asks."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _cameras() -> Iterable[str]:
    from glstar.camera.presets import camera_presets, sensor_presets  # noqa: PLC0415 - only where the shell asks

    return [*camera_presets(), *(mode.name for preset in sensor_presets().values() for mode in preset.modes)]


def _sensors() -> Iterable[str]:
    from glstar.camera.presets import sensor_presets  # noqa: PLC0415

    return sensor_presets()


def _column_maps() -> Iterable[str]:
    from glstar.telemetry.tables.mapped import ready_maps  # noqa: PLC0415

    return ready_maps()


camera_names = _completion(_cameras)
sensor_names = _completion(_sensors)
column_maps = _completion(_column_maps)
manual_topics = _completion(manual_pages)
