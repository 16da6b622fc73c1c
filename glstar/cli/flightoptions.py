"""The options of the commands that read a flight log or draw images, and the completion of their values."""

from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import partial, wraps
from inspect import Parameter, signature
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from glstar.camera.mounts import MOUNTS
from glstar.camera.presets import camera_presets, is_sensor_mode, sensor_presets
from glstar.cli.reporting import echo_note
from glstar.config import FLIGHT_FLAGS, Config
from glstar.config.flight import SYNTHETIC
from glstar.config.keys import KEY_FLAGS
from glstar.config.section import is_file_name
from glstar.errors import CatalogueError, ConfigError
from glstar.flight import Interpolation
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.system.resources import bundled_flight, flight_path


def completion(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a function that lists the names that begin with a word; they are read only where the shell asks."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


LensMm = Annotated[
    float | None, typer.Option("--lens-mm", help="Focal length of the lens before --camera's sensor, mm.", min=0.01)
]
FNumber = Annotated[
    float | None, typer.Option("--f-number", help="Focal length over aperture of that lens.", min=0.1, max=100)
]
AnalogueGain = Annotated[float | None, typer.Option("--gain", help="Analogue gain of --camera's sensor.", min=0.001)]

MountName = Annotated[
    str | None,
    typer.Option(
        "--mount",
        help="How the camera is mounted: zenith, down, nose, tail, left, right, forward-up-30, ...; see glstar manual"
        " mounts.",
        show_default="zenith, or the config's",
        autocompletion=completion(lambda: MOUNTS),
    ),
]

# Flags of the camera, for commands that draw no images.
CAMERA_FLAGS = frozenset({"camera", "lens_mm", "f_number", "gain"})

Flight = Annotated[
    Path | None,
    typer.Argument(
        help="A log of ArduPilot (.BIN, .log), MAVLink (.tlog), PX4 (.ulg), or a table; also in .gz or .zip; demo; or"
        " fly:orbit and other described flights (glstar manual fly).",
        show_default="the bundled flight",
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option("-c", "--config", help="A TOML file of settings.", show_default="the bundled camera")
]
UtcStart = Annotated[
    str | None,
    typer.Option(
        help="UTC of the first attitude, ISO 8601, for a log without UTC or with a wrong one.", show_default="the log's"
    ),
]
Lat = Annotated[
    float | None,
    typer.Option(help="Latitude, deg, north positive, for a log without positions.", show_default="the log's"),
]
Lon = Annotated[float | None, typer.Option(help="Longitude, deg, east positive.", show_default="the log's")]
Height = Annotated[
    float | None, typer.Option(help="Height of that place above the WGS84 ellipsoid, m.", show_default="0 with --lat")
]
Sysid = Annotated[
    int | None,
    typer.Option(
        help="MAVLink system of the vehicle, in a .tlog of several vehicles.", show_default="the first with attitude"
    ),
]
Vehicle = Annotated[
    str | None,
    typer.Option(
        help="The vehicle, in a log of several: its name space in a ROS bag, such as uav1, or its MAVLink system.",
        show_default="the one with attitude and position",
    ),
]
Boot = Annotated[
    int | None,
    typer.Option(
        help="Number of the boot in glstar info, in a log of several boots.",
        show_default="all of one day",
    ),
]
Attitude = Annotated[
    str | None, typer.Option(help="Which attitude of the log, by its name in glstar info.", show_default="auto")
]
TimeOffset = Annotated[
    float | None,
    typer.Option(
        help="The camera's clock minus the log's, s: what the camera stamps 12:00:05 with 3600 was taken at 11:00:05."
        " Sky, attitude and position keep the log's UTC.",
        show_default="0, or the config's",
    ),
]
Interpolate = Annotated[
    Interpolation | None,
    typer.Option("--interpolation", help="How attitude is interpolated between samples.", show_default="slerp"),
]
MaxGap = Annotated[
    float | None,
    typer.Option(help="Longest data gap of the log to interpolate across, s.", show_default="3 median intervals"),
]
Position = Annotated[
    str | None,
    typer.Option(
        help="A track with the positions of the flight: GPX, KML, KMZ, NMEA or IGC.", show_default="the log's"
    ),
]

Format = Annotated[
    Literal["png", "png16", "tiff", "fits", "jpeg"] | None,
    typer.Option(
        "--format",
        help="8-bit PNG, or PNG, TIFF or FITS of 16 bits, or JPEG.",
        show_default="png; png16 over 8 bits",
    ),
]


def _cameras() -> Iterable[str]:
    return [*camera_presets(), *(mode.name for preset in sensor_presets().values() for mode in preset.modes)]


def _column_maps() -> Iterable[str]:
    from glstar.telemetry.tables.mapped import ready_maps  # noqa: PLC0415 - only where the shell asks

    return ready_maps()


camera_names = completion(_cameras)
sensor_names = completion(sensor_presets)
column_maps = completion(_column_maps)

CameraName = Annotated[
    str | None,
    typer.Option(
        "--camera",
        help="A preset of glstar camera presets, the mode of a sensor such as imx477:2028x1520, or a calibration file.",
        show_default="the config's",
        autocompletion=camera_names,
    ),
]


def camera_settings(
    camera: str | None, lens_mm: float | None, f_number: float | None, gain: float | None = None
) -> dict[str, object]:
    """Return the values of the config, by dotted key, that the options set; None for keys that they leave unchanged.

    The mode of a sensor also replaces the noise of the config; what else it brings, the config knows.  `lens_mm`,
    `f_number`: the lens before the sensor; `gain`: analogue gain of the sensor.
    """
    settings: dict[str, object] = {
        "camera.lens_mm": lens_mm,
        "camera.f_number": f_number,
        "sensor.analogue_gain": gain,
    }
    if camera is not None:
        is_mode = is_sensor_mode(camera)
        settings["camera.preset" if is_mode or not is_file_name(camera) else "camera.file"] = camera
        if is_mode:
            settings["sensor.preset"] = camera
    return settings


Columns = Annotated[
    str | None,
    typer.Option(
        help="What the columns of a table mean: a map by name (euroc, tum, airdata, dji, csvview, xplane, betaflight,"
        " inav), a .toml file, or key=column,key=column; see glstar manual logs.",
        show_default="by its header",
        autocompletion=column_maps,
    ),
]


def log_of(flight: Path | None) -> Path:
    """Return the given log, by default or by the name ``demo`` the bundled one."""
    return bundled_flight() if flight is None else flight_path(flight)


def flights_of(settings: Config, flights: Collection[Path] | None) -> list[Path]:
    """Return the given flights, by default the flight of ``[flight.synthetic]``, else the bundled one.

    Raises ConfigError if both the command line and the config give a flight.
    """
    described = settings.synthetic.description
    if described is None:
        return [log_of(flight) for flight in flights] if flights else [log_of(None)]
    if flights:
        raise ConfigError(
            f"describes a flight, and the command line names {next(iter(flights))}; leave one of them out",
            key=SYNTHETIC,
            file=settings.file,
        )
    return [Path(described)]


def note_swept(settings: Config) -> None:
    """Note each flag that has no effect because the sweep varies what it sets."""
    for key in settings.overridden.keys() & {axis.key for axis in settings.sweep.axes}:
        echo_note(f"glstar: {KEY_FLAGS.get(key, key)} has no effect, because [sweep] varies {key}")


@dataclass(frozen=True, slots=True)
class FlightFlags:
    """The flags of a command that control how a log is read."""

    config: ConfigFile = None
    utc_start: UtcStart = None  # this and the next fields are keys of ``[flight]``
    lat: Lat = None
    lon: Lon = None
    height: Height = None
    sysid: Sysid = None
    vehicle: Vehicle = None
    boot: Boot = None
    attitude: Attitude = None
    time_offset: TimeOffset = None
    max_gap: MaxGap = None
    interpolation: Interpolate = None
    columns: Columns = None
    position: Position = None
    camera: CameraName = None  # this and the next fields: see `camera_settings`
    lens_mm: LensMm = None
    f_number: FNumber = None
    gain: AnalogueGain = None
    mount: MountName = None

    def settings(self, **others: object) -> Config:
        """Return the config of the file with the flags and other values, by dotted key, applied.

        Raises ConfigError if the file or a value is not valid.
        """
        lens = camera_settings(self.camera, self.lens_mm, self.f_number, self.gain)
        flight = {f"flight.{key}": getattr(self, _name(flag)) for key, flag in FLIGHT_FLAGS.items()}
        settings = (Config() if self.config is None else Config.load(self.config)).override(
            **flight, **lens, **{"mount.preset": self.mount}, **others
        )
        echo_catalogue_note(settings.sky.catalogue)
        return settings

    def given(self) -> dict[str, object]:
        """Return the given values by flag."""
        values = {flag: getattr(self, _name(flag)) for flag in ("--config", *FLIGHT_FLAGS.values())}
        return {flag: value for flag, value in values.items() if value is not None}

    def by_key(self) -> dict[str, str]:
        """Return the flags that set a value, by dotted key of the config."""
        settings = camera_settings(self.camera, self.lens_mm, self.f_number, self.gain)
        given = self.given()
        return {
            **{key: KEY_FLAGS.get(key, "--camera") for key, value in settings.items() if value is not None},
            **{f"flight.{key}": flag for key, flag in FLIGHT_FLAGS.items() if flag in given},
            **({} if self.mount is None else {"mount.preset": "--mount"}),
        }


def with_flight_flags(*, but: Collection[str] = ()) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace the parameter ``flags: FlightFlags`` of a command by one option for each flag.

    `but`: flags that the command does not have, by their names in `FlightFlags`.  Returns a decorator.
    """
    return partial(with_fields_as_options, parameter="flags", kind=FlightFlags, but=but)


def with_fields_as_options(
    command: Callable[..., None], parameter: str, kind: Any, *, but: Collection[str] = ()
) -> Callable[..., None]:
    """Replace a parameter of a command by one option for each field of its dataclass `kind`, except those in `but`."""
    options = {
        field.name: Parameter(field.name, Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type)
        for field in fields(kind)
        if field.name not in but
    }

    @wraps(command)
    def with_options(**values: Any) -> None:
        chosen = {name: values.pop(name) for name in options if name in values}
        command(**values, **{parameter: kind(**chosen)})

    own = signature(command)
    parameters = chain.from_iterable(
        options.values() if name == parameter else [other] for name, other in own.parameters.items()
    )
    with_options.__signature__ = own.replace(  # type: ignore[attr-defined]
        parameters=[option.replace(kind=Parameter.KEYWORD_ONLY) for option in parameters]
    )
    return with_options


def echo_catalogue_note(catalogue: str) -> None:
    """Write notes on a star catalogue, by its name or path, to standard error; nothing if it cannot be opened."""
    # The bundled file belongs to the installed version.
    if catalogue == "bsc5":
        return
    with suppress(CatalogueError):  # the command itself reports it
        note = StarCatalogue.open(catalogue).note
        if note:
            echo_note(f"note: {note}")


def _name(flag: str) -> str:
    """Return the field of `FlightFlags` for a flag."""
    return flag.removeprefix("--").replace("-", "_")
