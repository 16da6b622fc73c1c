"""Reading of TOML files into checked sections; validation errors are collected and reported together."""

from collections.abc import Mapping
from dataclasses import replace
from math import radians
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import ValidationError

from glstar.camera.camerafile import camera_from_file
from glstar.camera.distortion import Lens, LensModel
from glstar.camera.exposure import check_readouts
from glstar.camera.model import Camera
from glstar.camera.mounts import mount_by_name
from glstar.camera.presets import camera_from_preset, is_sensor_mode, preset_file, sensor_mode
from glstar.camera.sensor.colourband import ColourBand
from glstar.camera.sensor.sensor import EffectValue
from glstar.camera.sensor.tonecurve import is_curve_text
from glstar.config.camera import CameraSection, ExposureSection
from glstar.config.flight import SYNTHETIC, AirSection, FlightSection, MountSection, SyntheticSection
from glstar.config.keys import PATHS, PRESETS, SECTIONS, SOURCES, Fault, allowed, at_home, hint, key_text, shown
from glstar.config.section import Section, is_file_name
from glstar.config.sensor import SENSOR_MAPS, SensorSection, completed_sensor, foreign_keys
from glstar.config.sky import HORIZONS, SkySection
from glstar.errors import CalibrationError, ConfigError, reading
from glstar.render.effects import EFFECTS
from glstar.render.effects.sky import SKY_MAP_KEY, relative_sky
from glstar.sky.air.extinction import Extinction
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.satellites import Satellites
from glstar.sky.observed.stars import Sky
from glstar.sky.photometry import StarBrightness
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import HorizonProfile
from glstar.system.userinput import did_you_mean, read_toml
from glstar.telemetry import is_map_file
from glstar.telemetry.synthetic import OLD_KEYS, present_key

# The default camera: small enough that a frame takes about 30 ms without a GPU.
BUNDLED_CAMERA = "picamhq-6mm-binned4"
_NUMBERS_OF_A_CAMERA = ("width_px", "height_px", "fx_px", "fy_px")

# Size limit of a config, bytes: a larger file is probably a flight log given by mistake.
_LARGEST_BYTES = 2**20

# The values of each section by key, as given, before any check.
Tables = dict[str, dict[str, Any]]

S = TypeVar("S", bound=Section)
_PLACE = ("latitude_deg", "longitude_deg")


def bundled_camera() -> Camera:
    """Return the camera of a config without ``[camera]``."""
    return camera_from_preset(BUNDLED_CAMERA)


def toml_of(path: str | PathLike[str]) -> dict[str, Any]:
    """Return the content of a TOML file."""
    with reading(path, ConfigError):
        return read_toml(path, _LARGEST_BYTES)


def known_tables(document: dict[str, Any]) -> tuple[Tables, list[Fault]]:
    """Return the known sections of a document, and errors about all others."""
    tables: Tables = {}
    faults: list[Fault] = []
    for name, value in _with_subsections(document).items():
        if name not in SECTIONS:
            faults.append((key_text(name), f"is no section{at_home(name) or did_you_mean(name, list(SECTIONS))}"))
        elif not isinstance(value, dict):
            faults.append((name, f"must be a section, [{name}] with keys below it, not {shown(value)}"))
        else:
            tables[name] = value
    if SYNTHETIC in tables:
        tables[SYNTHETIC] = {present_key(key): value for key, value in tables[SYNTHETIC].items()}
    return tables, faults


def present(dotted: str) -> str:
    """Return a dotted key under its present name; warn of an old one."""
    section, _, key = dotted.rpartition(".")
    return f"{section}.{present_key(key)}" if section == SYNTHETIC and key in OLD_KEYS else dotted


def mount_table(table: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``[mount]`` before values are put into it: a preset replaces angles, and an angle is one of the preset."""
    angles = {"yaw_deg", "pitch_deg", "roll_deg", "reading"}
    if "mount.preset" in given:
        return {key: value for key, value in table.items() if key not in angles}
    if "preset" not in table or not {f"mount.{key}" for key in angles} & given.keys():
        return table
    named = mount_by_name(table["preset"])
    rest = {key: value for key, value in table.items() if key != "preset"}
    return {**rest, "yaw_deg": named.yaw_deg, "pitch_deg": named.pitch_deg, "roll_deg": named.roll_deg}


def mount_of(section: MountSection, tables: Tables, faults: list[Fault]) -> MountSection:
    """Return the section with the angles of its preset; if it has errors, append them to `faults`."""
    if section.preset is None:
        return section
    if both := sorted({"yaw_deg", "pitch_deg", "roll_deg", "reading"} & tables.get("mount", {}).keys()):
        faults.append(("mount", f"has preset and {' and '.join(both)}; give a preset or angles, and only one of them"))
        return section
    try:
        named = mount_by_name(section.preset)
    except ConfigError as error:
        faults.append(("mount.preset", str(error)))
        return section
    angles = {"yaw_deg": named.yaw_deg, "pitch_deg": named.pitch_deg, "roll_deg": named.roll_deg}
    return section.model_copy(update={key: float(value) for key, value in angles.items()})


def _with_subsections(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document with sections inside others under dotted names: ``[flight.synthetic]``."""
    sections = dict(document)
    for dotted in SECTIONS:
        outer, _, inner = dotted.rpartition(".")
        if outer and isinstance(sections.get(outer), Mapping) and inner in sections[outer]:
            sections[dotted] = sections[outer][inner]
            sections[outer] = {key: value for key, value in sections[outer].items() if key != inner}
    return sections


def with_sensor_of_camera(tables: Tables) -> Tables:
    """Return the tables with what the mode of a sensor in ``[camera]`` brings, where they do not say otherwise.

    It is the sensor's noise, unless ``[sensor]`` names another, a file, or keys of the paper's noise, and with it the
    vignetting of an ideal lens.  The readout time follows in `with_readout`.
    """
    name, sensor = tables.get("camera", {}).get("preset"), tables.get("sensor", {})
    if not isinstance(name, str) or not is_sensor_mode(name):
        return tables
    if not {"file", "noise", "preset"} & sensor.keys() and not foreign_keys(sensor, "electrons"):
        sensor = {**sensor, "preset": name}
    if sensor.get("preset") != name:
        return tables
    return {**tables, "sensor": sensor, "lens": {"vignetting": "cos4", **tables.get("lens", {})}}


def section_of(model: type[S], name: str, tables: Tables, faults: list[Fault]) -> S:
    """Return one section, checked; if it has errors, append them to `faults` and return the defaults."""
    try:
        return model.model_validate(tables.get(name, {}))
    except ValidationError as refusal:
        for error in refusal.errors(include_url=False, include_context=False):
            key = str(error["loc"][0])
            if error["type"] == "extra_forbidden":
                message = f"is no key of [{name}]{at_home(key) or did_you_mean(key, list(model.model_fields))}"
            else:
                message = f"must be {allowed(model, key)}, not {shown(error['input'])}{hint(model, key, error)}"
            if (f"{name}.{key_text(key)}", message) not in faults:  # of a key of several types: once
                faults.append((f"{name}.{key_text(key)}", message))
        return model()


def flight_of(section: FlightSection, faults: list[Fault]) -> FlightSection:
    """Return the section; latitude and longitude must be given together."""
    missing = [key for key in _PLACE if getattr(section, key) is None]
    if missing and (len(missing) < len(_PLACE) or section.height_m is not None):
        faults.extend((f"flight.{key}", "is missing from a place given in numbers") for key in missing)
    if section.position is not None and len(missing) < len(_PLACE):
        faults.append(("flight.position", "is a track, but a place is given in numbers too; leave one out"))
    return section


def synthetic_of(section: SyntheticSection, faults: list[Fault]) -> SyntheticSection:
    """Return the section; its keys must describe a flight, unless there are none."""
    if section.path is not None or section.settings:
        try:
            section.flight()
        except ConfigError as error:
            faults.append((SYNTHETIC, str(error).removeprefix("fly: ")))
    return section


def camera_of(section: CameraSection, tables: Tables, folder: Path, faults: list[Fault]) -> Camera:
    """Return the camera of the section; if it has errors, append them to `faults` and return the bundled camera."""
    keys = tables.get("camera", {})
    numbers = [key for key in keys if key in CameraSection.model_fields and key not in SOURCES]
    faults.extend(_lens_faults(section))
    sources = [*(key for key in ("file", "preset") if key in keys), *numbers[:1]]
    if len(sources) > 1:
        message = f"has {' and '.join(sources)}; give a file, or a preset, or numbers, and only one of them"
        if section.preset is not None and is_sensor_mode(section.preset):
            message += f' (the same sensor behind your own lens is [sensor] preset = "{section.preset}")'
        faults.append(("camera", message))
    elif section.camera is not None and (section.file is None or section.file.lower().endswith(".toml")):
        faults.append(("camera.camera", "names a camera of a YAML or JSON file with several; give camera.file too"))
    elif section.file is not None and section.file.lower().endswith(".toml"):
        return _camera_of_calibration(folder / section.file, faults)
    elif section.file is not None:
        try:
            return camera_from_file(folder / section.file, section.camera)
        except CalibrationError as error:
            faults.append(("camera.file", str(error)))
    elif section.preset is not None:
        try:
            return camera_from_preset(str(absolute("camera.preset", section.preset, folder)), section.lens_mm)
        except ConfigError as error:
            key = error.key or "camera.preset"
            faults.append((key, str(error).removeprefix(f"{key}: ")))
    elif numbers:
        missing = [key for key in _NUMBERS_OF_A_CAMERA if key not in keys]
        faults.extend((f"camera.{key}", "is missing from a camera given in numbers") for key in missing)
        if section.width_px and section.height_px and section.fx_px and section.fy_px:
            return Camera(
                width_px=section.width_px,
                height_px=section.height_px,
                fx_px=section.fx_px,
                fy_px=section.fy_px,
                cx_px=(section.width_px - 1) / 2 if section.cx_px is None else section.cx_px,
                cy_px=(section.height_px - 1) / 2 if section.cy_px is None else section.cy_px,
                skew_px=section.skew_px or 0.0,
                lens=_lens(section, faults),
            )
    return bundled_camera()


def _lens_faults(section: CameraSection) -> list[Fault]:
    """Return the errors of the lens before a sensor."""
    if section.f_number is not None and section.lens_mm is None:
        return [("camera.f_number", "needs lens_mm; of a camera without it, give sensor.aperture_mm")]
    if section.lens_mm is not None and section.preset is None:
        return [("camera.lens_mm", 'belongs to the preset of a sensor, such as preset = "imx477:2028x1520"')]
    return []


def _camera_of_calibration(path: Path, faults: list[Fault]) -> Camera:
    """Return the camera and lens of a TOML file as written by `glstar camera calibrate`."""
    try:
        document = toml_of(path)
    except ConfigError as error:
        faults.append(("camera.file", str(error)))
        return bundled_camera()
    # The file may have other tables, such as [sensor]; only [camera] is read here.
    tables, problems = known_tables({key: document[key] for key in ("camera",) if key in document})
    if "camera" not in document:
        problems = [("camera", "is missing; a calibration in TOML has a [camera] section")]
    elif {"file", "preset"} & set(tables.get("camera", {})):
        problems = [("camera", "must hold the numbers, not file or preset")]
    camera = camera_of(section_of(CameraSection, "camera", tables, problems), tables, path.parent, problems)
    faults.extend(("camera.file", f"{path}: {key}: {message}") for key, message in problems)
    return camera


def _lens(section: CameraSection, faults: list[Fault]) -> Lens | None:
    """Return the lens of a camera given in numbers."""
    if section.lens == "none":
        if section.distortion is not None:
            models = " or ".join(f'"{model}"' for model in get_args(LensModel))
            faults.append(("camera.lens", f"is missing beside distortion; it is {models}"))
        if section.max_angle_deg is not None:
            faults.append(("camera.max_angle_deg", "needs a lens"))
        return None
    try:
        return Lens(section.lens, tuple(section.distortion or ()), radians(section.max_angle_deg or 180.0))
    except CalibrationError as error:
        faults.append(("camera.distortion", str(error)))
        return None


def sensor_of(
    section: SensorSection, tables: Tables, folder: Path, faults: list[Fault], camera: Camera, lens: CameraSection
) -> SensorSection:
    """Return the sensor's section with the values of its file, if it names one, and of its preset."""
    aperture_mm = lens.lens_mm / lens.f_number if lens.lens_mm and lens.f_number else None
    others = [key for key in tables.get("sensor", {}) if key in SensorSection.model_fields and key != "file"]
    if section.file is None:
        problems: list[Fault] = []
        section = _with_absolute_paths(section, folder)
        section = completed_sensor(section, tables.get("sensor", {}), camera, aperture_mm, problems)
        _check_sky_map(section, problems)
        if section.noise == "electrons" and _is_lit_naturally(tables):
            section = section.model_copy(update={"sky_e_per_s": 0.0})
        # Without a valid camera, it is not known which mode of a sensor fits.
        has_camera = not any(key.startswith("camera") for key, _ in faults)
        faults.extend(fault for fault in problems if has_camera or fault[0] != "sensor.preset")
        return section
    if others:
        faults.append(("sensor", f"has file and {others[0]}; give a file or numbers, not both"))
        return section
    path = folder / section.file
    try:
        document = toml_of(path)
    except ConfigError as error:
        faults.append(("sensor.file", str(error)))
        return section
    # The file may have other tables, such as [camera]; only [sensor] is read here.
    own_tables, problems = known_tables({key: document[key] for key in ("sensor",) if key in document})
    if "sensor" not in document:
        problems = [("sensor", "is missing; a sensor calibration is a TOML file with a [sensor] section")]
    elif "file" in own_tables.get("sensor", {}):
        problems = [("sensor.file", "is not allowed in a calibration file, which must hold the numbers")]
    else:
        section = _with_absolute_paths(section_of(SensorSection, "sensor", own_tables, problems), path.parent)
        section = completed_sensor(section, own_tables.get("sensor", {}), camera, aperture_mm, problems)
        _check_sky_map(section, problems)
    faults.extend(("sensor.file", f"{path}: {key}: {message}") for key, message in problems)
    return section


def _with_absolute_paths(section: SensorSection, folder: Path) -> SensorSection:
    """Return the sensor's section with the absolute paths of its preset's file, star brightness table and maps."""
    keys = ("preset", "star_brightness", *SENSOR_MAPS)
    return section.model_copy(update={key: absolute(f"sensor.{key}", getattr(section, key), folder) for key in keys})


def _check_sky_map(section: SensorSection, faults: list[Fault]) -> None:
    """Append an error to `faults` if the section's map of the sky cannot be used."""
    file = str(getattr(section, SKY_MAP_KEY.name))
    try:
        if file:
            relative_sky(file)
    except ConfigError as error:
        faults.append(("sensor.sky_map", str(error).removeprefix("sensor.sky_map: ")))


def star_brightness_of(section: SensorSection, faults: list[Fault]) -> StarBrightness | None:
    """Return the section's table of star brightness; None if there is none, or with an error appended to `faults`."""
    if section.star_brightness is None:
        return None
    try:
        return StarBrightness.open(section.star_brightness)
    except CalibrationError as error:
        faults.append(("sensor.star_brightness", str(error)))
        return None


def with_readout(section: ExposureSection, tables: Tables, *presets: str | None) -> ExposureSection:
    """Return the exposure with the readout time of the first preset that is a mode of a sensor, unless it is given.

    Raises ConfigError if short exposures of a rolling shutter follow each other faster than it reads them.
    """
    modes = [sensor_mode(name) for name in presets if name is not None and is_sensor_mode(name)]
    if "readout_s" not in tables.get("exposure", {}) and modes and modes[0] is not None:
        section = section.model_copy(update={"readout_s": modes[0].readout_s})
    check_readouts(section.duration_s, section.readout_s, section.frames, section.gap_s)
    return section


def source_of(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that name the source of the numbers."""
    return {key: keys[key] for key in SOURCES if key in keys}


def is_path(dotted: str, value: object) -> bool:
    """Return whether this value of a key is a path, or a preset in a file; some keys have other values too."""
    if dotted in PRESETS:
        return isinstance(value, str) and preset_file(value) is not None
    if dotted not in PATHS or not isinstance(value, str | PathLike) or not str(value):
        return False
    return dotted != "output.tone_curve" or not is_curve_text(str(value))


def absolute(dotted: str, value: object, folder: Path) -> object:
    """Return the absolute path if this key holds a path; return other values unchanged."""
    if not is_path(dotted, value):
        return value
    if dotted in {"sky.catalogue", "sky.horizon"} and not is_file_name(str(value)):
        return value
    if dotted == "flight.columns" and not is_map_file(str(value)):
        return value
    return str((folder / str(value)).absolute())


def sky_of(section: SkySection, folder: Path, faults: list[Fault]) -> SkySection:
    """Return the section with absolute paths; the files that it names must be valid."""
    paths = {
        key: absolute(f"sky.{key}", getattr(section, key), folder) for key in ("catalogue", "horizon", "satellites")
    }
    section = section.model_copy(update=paths)
    try:
        _horizon_profile(section)
    except ConfigError as error:
        faults.append(("sky.horizon", str(error).removeprefix("sky.horizon: ")))
    try:
        _satellites(section)
    except ConfigError as error:
        faults.append(("sky.satellites", str(error).removeprefix("sky.satellites: ")))
    return section


def observed_sky(section: SkySection, stars: StarCatalogue) -> Sky:
    """Return the sky of the section with some stars.

    Raises ConfigError if the file of a horizon profile or of satellites has changed and is no longer valid.
    """
    return Sky(
        catalogue=stars,
        astrometry=ASTROMETRY[section.astrometry],
        dut1_s=section.dut1_s,
        refraction=section.refraction,
        dip=section.horizon == "dip",
        profile=_horizon_profile(section),
        satellites=_satellites(section),
    )


def _horizon_profile(section: SkySection) -> HorizonProfile | None:
    return None if section.horizon in HORIZONS else HorizonProfile.open(section.horizon)


def _satellites(section: SkySection) -> Satellites | None:
    return None if section.satellites is None else Satellites.open(section.satellites, section.satellite_mag)


def extinction_of(sky: SkySection, air: AirSection, colour: ColourBand | None = None) -> Extinction | None:
    """Return the extinction by the air above the aircraft; None with ``sky.extinction = "none"``.

    `colour`: the band of the sensor, for ``sky.extinction_band = "sensor"``.
    """
    if sky.extinction == "none":
        return None
    pressure_hpa = air.pressure_hpa if sky.extinction == "pressure" else None
    extinction = Extinction(air.rayleigh_mag, air.aerosol_mag, air.aerosol_scale_m, air.ozone_mag, pressure_hpa)
    if sky.extinction_band == "eye" or colour is None:
        return extinction
    return replace(extinction.at_wavelength(colour.wavelength_nm()), by_channel=True)


def _is_lit_naturally(tables: Tables) -> bool:
    """Return whether the natural sky replaces the uniform one, which is not given."""
    sky, sensor = tables.get("sky", {}), tables.get("sensor", {})
    brightness = sky.get("brightness", "natural" if sky.get("preset") in ("natural", "full") else "flat")
    return brightness == "natural" and not {"sky_e_per_s", "sky_mag_per_arcsec2"} & sensor.keys()


def sky_effects(sky: SkySection) -> dict[str, EffectValue]:
    """Return the values, by dotted key, of the effects whose keys are in ``[sky]``."""
    return {
        f"sky.{key.name}": getattr(sky, key.name)
        for effect in EFFECTS
        if effect.section == "sky"
        for key in effect.keys
    }
