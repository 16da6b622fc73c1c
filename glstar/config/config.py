"""All settings of glstar as one value, and the origin of each: a flag, the file, a preset, or the default.

Degrees are converted to radians here; the other packages use SI units, radians and pixels.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import radians
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from glstar.camera.model import Camera, Mount
from glstar.camera.presets import preset_file
from glstar.camera.sensor.sensor import Sensor
from glstar.config import reading
from glstar.config.camera import (
    CameraSection,
    ExposureSection,
    camera_numbers,
    checked_control,
    checked_lens,
    checked_output,
)
from glstar.config.flight import SYNTHETIC, AirSection, FlightSection, MountSection, NavigatorSection, SyntheticSection
from glstar.config.keys import (
    EFFECT_DEFAULTS,
    SECTIONS,
    SOURCES,
    Fault,
    config_error,
    effect_values,
    key_text,
    split_key,
    toml_value,
)
from glstar.config.sensor import SensorSection, for_another_noise_model, sensor_from
from glstar.config.sky import HORIZONS, SkySection, resolved_sky
from glstar.config.sweep import START, Sweep
from glstar.errors import ConfigError
from glstar.flight import Flight
from glstar.flight.gimbal import Gimbal
from glstar.render.simulator import Simulator
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.photometry import StarBrightness
from glstar.system.userinput import did_you_mean
from glstar.telemetry import Survey, TelemetrySource, open_source, read_flight, survey

DEFAULT = "default"
# A value and where it comes from.
Origin = tuple[Any, str]


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of glstar.

    ``Config()`` has the defaults, `load` reads a file, and `override` applies command-line flags.  Two configs with the
    same settings are equal, even if they were read from different files.

    Attributes
    ----------
    exposure : ExposureSection
        ``[exposure]``.
    sky : SkySection
        ``[sky]``.
    air : AirSection
        ``[air]``.
    flight : FlightSection
        ``[flight]``.
    synthetic : SyntheticSection
        ``[flight.synthetic]``: a flight without a log.
    navigator : NavigatorSection
        ``[navigator]``: what the aircraft knows.
    sweep : Sweep
        ``[sweep]``.
    file : pathlib.Path or None
        The TOML file; paths in it are relative to its folder.
    """

    exposure: ExposureSection = field(default_factory=ExposureSection)
    sky: SkySection = field(default_factory=SkySection)
    air: AirSection = field(default_factory=AirSection)
    flight: FlightSection = field(default_factory=FlightSection)
    synthetic: SyntheticSection = field(default_factory=SyntheticSection)
    navigator: NavigatorSection = field(default_factory=NavigatorSection)
    sweep: Sweep = field(default_factory=Sweep)
    file: Path | None = field(default=None, compare=False)
    _camera: Camera = field(default_factory=reading.bundled_camera)
    _mount: MountSection = field(default_factory=MountSection)
    _sensor: SensorSection = field(default_factory=SensorSection)
    _star_brightness: StarBrightness | None = None
    # Values of the effects that have their own table, by table and key.
    _effects: reading.Tables = field(default_factory=lambda: effect_values(lambda model, _: model()), hash=False)
    # The values of the file and of flags: `override` checks them again, and `resolved` reports their sources.
    _tables: reading.Tables = field(default_factory=dict, compare=False, repr=False)
    # The values that `override` has set, by dotted key: see `overridden`.
    _overridden: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Return the config of a TOML file.

        Parameters
        ----------
        path : path-like
            The file; paths inside it are relative to its folder.

        Returns
        -------
        Config

        Raises
        ------
        ConfigError
            If the file cannot be read or is not TOML; otherwise with all validation errors at once, each with the
            key, the values it may have, and the value given.
        """
        document = reading.toml_of(path)
        swept = document.pop("sweep", {})
        tables, faults = reading.known_tables(document)
        sweep = Sweep.of(swept, faults)
        config = replace(cls._made(tables, faults, Path(path).absolute(), source=path), sweep=sweep)
        for settings in sweep.extremes():
            try:
                config.at(settings)
            except ConfigError as error:
                raise ConfigError(f"[sweep] goes to where {error}", file=path, key=error.key) from None
        return config

    def at(self, settings: Mapping[str, Any]) -> Self:
        """Return the config of one sample of its sweep.

        Parameters
        ----------
        settings : mapping
            Values by dotted key, as returned by `Sweep.sample`.

        Returns
        -------
        Config
            Without a sweep.

        Raises
        ------
        ConfigError
            With all validation errors at once.
        """
        folder = Path() if self.file is None else self.file.parent
        flags = {key: reading.absolute(key, value, folder) for key, value in settings.items() if key != START}
        return replace(self.override(**flags), sweep=Sweep())

    def override(self, **flags: Any) -> Self:
        """Return the config with other values of some keys, as for command-line flags; all keys are checked again.

        Parameters
        ----------
        **flags
            Values by dotted key: ``config.override(**{"exposure.duration_s": 1.0})``.  None leaves a key unchanged.
            Paths are relative to the working directory.  Another camera file or preset replaces the whole camera;
            another noise model or preset of the sensor replaces the keys of the former one; a number of the sensor
            overrides the value in its file.

        Returns
        -------
        Config

        Raises
        ------
        ConfigError
            With all validation errors at once.
        """
        tables = {section: dict(keys) for section, keys in self._tables.items()}
        given = {key: reading.absolute(key, value, Path.cwd()) for key, value in flags.items() if value is not None}
        given = {reading.present(key): value for key, value in given.items()}
        if "mount" in tables:
            tables["mount"] = reading.mount_table(tables["mount"], given)
        if {"camera.file", "camera.preset"} & given.keys():
            tables["camera"] = {}
        if "sensor.file" in given:
            tables["sensor"] = {}
        elif {"sensor.noise", "sensor.preset"} & given.keys():
            tables["sensor"] = for_another_noise_model(self._sensor.given, tables.get("sensor", {}), given)
        elif any(key.startswith("sensor.") for key in given) and "file" in tables.get("sensor", {}):
            tables["sensor"] = self._sensor.given

        faults: list[Fault] = []
        for dotted, value in given.items():
            section, key = split_key(dotted)
            if section in SECTIONS and key:
                tables.setdefault(section, {})[key] = value
            else:
                every = [f"{name}.{known}" for name, model in SECTIONS.items() for known in model.model_fields]
                sections = f" (the sections are {', '.join(SECTIONS)})"
                faults.append((key_text(dotted), f"is no key{did_you_mean(dotted, every, or_else=sections)}"))
        made = self._made(tables, faults, self.file, source=None)
        return replace(made, sweep=self.sweep, _overridden={**self._overridden, **given})

    def without(self, *keys: str) -> Self:
        """Return the config with some keys reset to their defaults.

        Parameters
        ----------
        *keys : str
            Dotted: ``config.without("flight.utc_start")``.

        Returns
        -------
        Config

        Raises
        ------
        ConfigError
            If the remaining keys are not valid, such as a latitude without a longitude.
        """
        tables = {
            section: {key: value for key, value in values.items() if f"{section}.{key}" not in keys}
            for section, values in self._tables.items()
        }
        return replace(self._made(tables, [], self.file, source=None), sweep=self.sweep, _overridden=self._overridden)

    def for_a_table(self, *, time_offset_s: float) -> Self:
        """Return the config for a log with UTC and positions: only two keys of ``[flight]`` keep their values.

        These are ``max_gap_s`` and ``interpolation``.

        Parameters
        ----------
        time_offset_s : float
            The camera's clock minus the log's, s.

        Returns
        -------
        Config
        """
        kept = {"max_gap_s", "interpolation"}
        flight = {key: value for key, value in self._tables.get("flight", {}).items() if key in kept}
        flight["time_offset_s"] = time_offset_s
        return self._made(self._tables | {"flight": flight}, [], self.file, source=None)

    def camera(self) -> Camera:
        """Return the camera.

        Returns
        -------
        Camera
            All lengths in px.
        """
        return self._camera

    def mount(self) -> Mount:
        """Return the nominal orientation of the camera on the aircraft, without the error in ``[navigator]``.

        Returns
        -------
        Mount
            Angles in rad.
        """
        mount = self._mount
        return Mount(radians(mount.roll_deg), radians(mount.pitch_deg), radians(mount.yaw_deg), mount.reading)

    @property
    def gimbal(self) -> Gimbal:
        """What carries the camera."""
        return self._mount.carrier

    def sensor(self) -> Sensor:
        """Return the sensor, with its brightness in DN."""
        effects = {f"{name}.{key}": value for name, keys in self._effects.items() for key, value in keys.items()}
        effects |= reading.sky_effects(self.sky)
        sensor = sensor_from(self._sensor.numbers, effects)
        changed = {key: value for key, value in sensor.effects.items() if value != EFFECT_DEFAULTS.get(key)}
        return replace(sensor, effects=changed)

    def star_brightness(self) -> StarBrightness | None:
        """Return the measured magnitudes of stars in the camera's band.

        Returns
        -------
        StarBrightness or None
            None if ``sensor.star_brightness`` is not given.
        """
        return self._star_brightness

    def open_flight(self, path: str | PathLike[str]) -> Flight:
        """Return the flight of a log, read with the options of ``[flight]``.

        Parameters
        ----------
        path : path-like
            The log.

        Returns
        -------
        Flight

        Raises
        ------
        LogFormatError
            If the log cannot be replayed.
        """
        with _open_log(path, self.flight) as source:
            return self.gimbal.carried(read_flight(source, self.flight.options))

    def survey_flight(
        self, path: str | PathLike[str], *, flags: Mapping[str, object] = MappingProxyType({})
    ) -> tuple[Survey, Flight]:
        """Return the survey of a log and its flight, read with the options of ``[flight]``.

        Parameters
        ----------
        path : path-like
            The log.
        flags : mapping of str to object
            Command-line flags of the log, for the command that the survey suggests.

        Returns
        -------
        Survey
        Flight
            If neither the log nor ``[flight]`` has UTC or a position, at 1970 or at 0 N 0 E.

        Raises
        ------
        LogFormatError
            If the log has no attitude.
        """
        with _open_log(path, self.flight) as source:
            return survey(source, self.flight.options, flags=flags)

    def simulator(
        self, flight: Flight, *, sensor: Sensor | None = None, stars: StarCatalogue | None = None
    ) -> Simulator:
        """Return the simulator of a flight with the sky, camera and sensor of this config.

        Parameters
        ----------
        flight : Flight
        sensor : Sensor, optional
            A sensor to use instead of ``[sensor]``.
        stars : StarCatalogue, optional
            The stars of ``[sky]``, if they have been read already.

        Returns
        -------
        Simulator

        Raises
        ------
        CatalogueError
            If the star catalogue cannot be opened.
        CalibrationError
            If ``sensor.star_brightness`` belongs to another catalogue.
        """
        if stars is None:
            stars = StarCatalogue.open(self.sky.catalogue).brighter_than(self.sky.vmag_limit)
        sensor = self.sensor() if sensor is None else sensor
        return Simulator.of(
            flight=flight,
            sky=reading.observed_sky(self.sky, stars),
            camera=self.camera(),
            mount=self.navigator.real_mount(self.mount()),
            gimbal=self.gimbal,
            sensor=sensor,
            pressure_hpa=self.air.pressure_hpa,
            temperature_c=self.air.temperature_c,
            star_brightness=self.star_brightness(),
            bodies=self.sky.bodies,
            earthshine=self.sky.earthshine,
            extinction=reading.extinction_of(self.sky, self.air, sensor.colour),
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Absolute paths of the camera, sensor, preset and star brightness files, which `at` reads for each sample."""
        folder = Path() if self.file is None else self.file.parent
        values = [(f"{name}.{key}", value) for name, keys in self._tables.items() for key, value in keys.items()]
        values += [(axis.key, value) for axis in self.sweep.axes for value in axis.values]
        named = {
            reading.absolute(key, value, folder)
            for key, value in values
            if reading.is_path(key, value) and key not in {"sky.catalogue", "flight.columns", "flight.position"}
            if key != "sky.horizon" or value not in HORIZONS
        }
        if self._star_brightness is not None:
            named.add(str(self._star_brightness.path))
        return tuple(Path(name) for name in sorted({preset_file(str(name)) or str(name) for name in named}))

    def resolved(self) -> dict[str, dict[str, Any]]:
        """Return every value of the config, section by section, ready for JSON and TOML.

        Returns
        -------
        dict
            The camera and the sensor as numbers, with ``preset`` or ``file`` as their source.  Keys of ``[flight]``
            that were not given are left out.
        """
        # Without [camera], the bundled camera is used.
        camera_keys = self._tables.get("camera") or {"preset": reading.BUNDLED_CAMERA}
        return {
            "camera": camera_numbers(self._camera) | reading.source_of(camera_keys),
            "mount": self._mount.model_dump(exclude_none=True),
            "exposure": self.exposure.model_dump(exclude_none=True),
            "sensor": self._sensor.given
            | reading.source_of(reading.with_sensor_of_camera(self._tables).get("sensor", {})),
            "sky": resolved_sky(self.sky),
            "air": self.air.model_dump(),
            "flight": self.flight.model_dump(exclude_none=True),
            **{name: _as_given(self._tables[name]) for name in (SYNTHETIC, "navigator") if self._tables.get(name)},
            **{name: dict(keys) for name, keys in self._effects.items()},
        }

    @property
    def given(self) -> reading.Tables:
        """The values of the file and of flags, by section and key."""
        return self._tables

    @property
    def overridden(self) -> dict[str, Any]:
        """The values in effect that flags or `override` have set, not the file, by dotted key; paths are absolute."""
        values = ((dotted, split_key(dotted), value) for dotted, value in self._overridden.items())
        return {
            dotted: value
            for dotted, (section, key), value in values
            if key in self._tables.get(section, {}) and self._tables[section][key] == value
        }

    def to_toml(self) -> str:
        """Return the config as a self-contained TOML file, which loads to an equal config from any folder.

        Returns
        -------
        str
            All values; the sources of camera and sensor are comments.
        """
        lines = []
        for section, values in self.resolved().items():
            lines.append(f"[{section}]")
            for key, value in values.items():
                if (section, key, self.sky.dut1_s) == ("sky", "dut1_s", None):
                    continue  # another computer may have the IERS table
                lines.append(f"{'# from ' if key in SOURCES else ''}{key} = {toml_value(value)}")
            lines.append("")
        return "\n".join(lines)

    @classmethod
    def _made(
        cls, tables: reading.Tables, faults: list[Fault], file: Path | None, source: str | PathLike[str] | None
    ) -> Self:
        """Return the config of these tables; raise one ConfigError with all validation errors.

        The message names the source file, if there is one.
        """
        folder = Path() if file is None else file.parent
        given, tables = tables, reading.with_sensor_of_camera(tables)
        lens = reading.section_of(CameraSection, "camera", tables, faults)
        camera = reading.camera_of(lens, tables, folder, faults)
        mount = reading.mount_of(reading.section_of(MountSection, "mount", tables, faults), tables, faults)
        exposure = reading.section_of(ExposureSection, "exposure", tables, faults)
        sensor = reading.sensor_of(
            reading.section_of(SensorSection, "sensor", tables, faults), tables, folder, faults, camera, lens
        )
        checked_control(exposure, sensor.noise, faults)
        star_brightness = reading.star_brightness_of(sensor, faults)
        sky = reading.sky_of(reading.section_of(SkySection, "sky", tables, faults), folder, faults)
        air = reading.section_of(AirSection, "air", tables, faults)
        flight = reading.flight_of(reading.section_of(FlightSection, "flight", tables, faults), faults)
        synthetic = reading.synthetic_of(reading.section_of(SyntheticSection, SYNTHETIC, tables, faults), faults)
        navigator = reading.section_of(NavigatorSection, "navigator", tables, faults)
        effects = effect_values(lambda model, name: reading.section_of(model, name, tables, faults))
        effects["lens"] = checked_lens(effects["lens"], camera, folder, faults)
        effects["output"] = checked_output(effects["output"], folder, faults)
        if faults:
            raise config_error(faults, source)
        presets = (reading.absolute("camera.preset", lens.preset, folder), sensor.preset)
        exposure = reading.with_readout(exposure, tables, *(str(name) for name in presets if name is not None))
        paths = {
            key: reading.absolute(f"flight.{key}", getattr(flight, key), folder) for key in ("columns", "position")
        }
        return cls(
            exposure=exposure,
            sky=sky,
            air=air,
            flight=flight.model_copy(update=paths),
            synthetic=synthetic,
            navigator=navigator,
            file=file,
            _camera=camera,
            _mount=mount,
            _sensor=sensor,
            _star_brightness=star_brightness,
            _effects=effects,
            _tables=given,
        )


def _as_given(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section as it was given; times without quotes, which TOML reads as datetimes, as text."""
    return {key: value.isoformat() if hasattr(value, "isoformat") else value for key, value in table.items()}


def _open_log(path: str | PathLike[str], flight: FlightSection) -> TelemetrySource:
    """Open a log with the options of ``[flight]``."""
    return open_source(
        path,
        attitude=flight.attitude,
        sysid=flight.sysid,
        boot=flight.boot,
        columns=flight.columns,
        vehicle=flight.vehicle,
    )


def origins(config: Config, flags: Mapping[str, str]) -> dict[str, dict[str, Origin]]:
    """Return every value of a config with its origin, by section and key.

    `flags`: flags of the command line, by dotted key.  An origin is a flag, the config file, a preset or file that
    either names, or "default".
    """
    document = {} if config.file is None else reading.toml_of(config.file)
    resolved = config.resolved()
    defaults = Config().resolved()
    electrons = Config().override(**{"sensor.noise": "electrons"}).resolved()["sensor"]
    defaults["sensor"] = electrons | {"noise": "paper"} | defaults["sensor"]
    sources = {section: _source(section, config.given.get(section, {}), flags) for section in resolved}
    # The mode of a sensor in [camera] has its noise, its readout time, and an ideal lens.
    sources |= {section: sources[section] or sources["camera"] for section in ("sensor", "lens")}
    sources["exposure"] = sources["camera"] or sources["sensor"]

    def origin_of(section: str, key: str, value: object) -> str:
        if flag := flags.get(f"{section}.{key}"):
            return flag
        if config.file is not None and key in _table(document, section) and key in config.given.get(section, {}):
            return config.file.name
        is_default = value == defaults.get(section, {}).get(key, None if key in SOURCES else value)
        return (sources[section] if section == "camera" or not is_default else "") or DEFAULT

    return {
        section: {key: (value, origin_of(section, key, value)) for key, value in values.items()}
        for section, values in resolved.items()
    }


def _source(section: str, given: Mapping[str, Any], flags: Mapping[str, str]) -> str:
    """Return the preset or the file that a section names, after the flag that names it if one does, or ""."""
    # The bundled camera is the default too, though it is a preset.
    key = next((key for key in SOURCES if key in given), "")
    return f"{flags.get(f'{section}.{key}', key)} {given[key]}" if key else ""


def _table(document: Mapping[str, Any], section: str) -> Mapping[str, Any]:
    """Return a section of a document; ``flight.synthetic`` is a table inside another."""
    table: Any = document
    for part in section.split("."):
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
    return table if isinstance(table, Mapping) else {}
