"""The keys of the truth: of a frame, and of the stars, bodies and satellites on it."""

from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal[
    "float",
    "int32",
    "int64",
    "string",
    "bool",
    "utc",  # ISO 8601
    "position",  # [x, y], px, or null
    "segments",  # of a stack: [start, end] of each short exposure
    "float[]",  # a list of any length
    "float[3]",
    "float[4]",
    "float[9]",  # a matrix: three rows
    "object",  # a nested object
    "table",  # a list of objects
]


@dataclass(frozen=True, slots=True)
class Column:
    """A key of the truth."""

    name: str  # The key; of a nested object its path, such as ``site.latitude_deg``
    kind: Kind
    unit: str  # Empty for a number without a unit, and for text
    text: str  # Meaning, Markdown
    when: str = ""  # What adds the key, Markdown; empty if it is always there
    parts: tuple[str, ...] = ()  # Columns of flat tables for the elements of a list
    of: str = ""  # "frame", "star", "body" or "satellite"


_STACK = "`[exposure] frames` above 1"
_ROLLING = "`[exposure] readout_s` above 0"
_ELECTRONS = '`[sensor] noise = "electrons"`'
_NATURAL = '`[sky] brightness = "natural"`'
_CLOUD = "`[cloud]`"
_EXTINCTION = "`[sky] extinction`"
_BAND = "`[sensor] band`"
_BLOOMING = "`[sensor] blooming`"
_SET = "in data sets"
_COMMANDED = "`live --mavlink-camera`"
_WIDTH = "`[sensor] psf_growth`, `psf_tilt` or `psf_colour_growth`"
_START_XY = ("start_x_px", "start_y_px")
_END_XY = ("end_x_px", "end_y_px")

_FRAME = (
    Column("schema", "string", "", '`"glstar-truth-2"`'),
    Column("frame", "int64", "", "number of the frame"),
    Column("file", "string", "", "name of its image"),
    Column("utc_start", "utc", "", "UTC of the attitude, position and sky as the shutter opens, ISO 8601"),
    Column("utc_mid", "utc", "", "the same in the middle of the exposure"),
    Column("camera_utc_start", "utc", "", "what the camera's clock shows then: UTC plus `flight.time_offset_s`"),
    Column("camera_utc_mid", "utc", "", "the same in the middle of the exposure"),
    Column("duration_s", "float", "s", "exposure time; of one short exposure of a stack"),
    Column("frames", "int64", "", "number of short exposures", _STACK),
    Column("gap_s", "float", "s", "time between two short exposures", _STACK),
    Column("stack", "string", "", '`"sum"` or `"mean"`', _STACK),
    Column("total_s", "float", "s", "time from the first opening to the last closing", _STACK),
    Column("readout_s", "float", "s", "time from the opening of the first row to that of the last", _ROLLING),
    Column("readout", "string", "", "direction of the readout, as in the config", _ROLLING),
    Column(
        "rates_rad_per_s",
        "float[3]",
        "rad/s",
        "rate of the camera among the stars at `utc_mid`: about its right, down and forward axes",
        _ROLLING,
    ),
    Column("seed", "int64", "", "seed of the noise"),
    Column("sub_exposures", "int64", "", "number of sub-exposures, or of segments of analytic trails"),
    Column("site", "object", "", "position of the aircraft, mid-exposure"),
    Column("site.latitude_deg", "float", "deg", "WGS84"),
    Column("site.longitude_deg", "float", "deg", "WGS84, east positive"),
    Column("site.height_m", "float", "m", "height"),
    Column(
        "q_body_ned",
        "float[4]",
        "",
        "attitude, mid-exposure: (w, x, y, z), NED to body, or to the platform of a gimbal",
        parts=("qw", "qx", "qy", "qz"),
    ),
    Column("C_camera_body", "float[9]", "", "the mount: rotation from the body to the camera, 3 x 3"),
    Column("C_camera_icrs", "float[9]", "", "rotation from ICRS to the camera, mid-exposure, 3 x 3"),
    Column("up_camera", "float[3]", "", "unit vector to the zenith in the camera frame, mid-exposure"),
    Column("camera", "object", "", "the camera, as in `[camera]` of a config"),
    Column("camera.K", "float[9]", "px", "camera matrix, 3 x 3"),
    Column("camera.width_px", "int32", "px", "width of the image"),
    Column("camera.height_px", "int32", "px", "height of the image"),
    Column("camera.lens", "string", "", "lens model"),
    Column("camera.distortion", "float[]", "", "coefficients of the lens model"),
    Column("camera.max_angle_deg", "float", "deg", "where the image circle ends", "`[camera] max_angle_deg`"),
    Column(
        "catalogue",
        "string",
        "",
        'catalogue of `star_id`: `"bsc5"`, `"hipparcos"`, `"tycho2"` or `"gaia"`; empty for a table of your own',
    ),
    Column("stars", "table", "", "list of stars, brightest first (below)"),
    Column("gimbal", "object", "", "attitude in front of the gimbal", "`[mount] gimbal`"),
    Column(
        "gimbal.q_aircraft_ned",
        "float[4]",
        "",
        "attitude of the aircraft, mid-exposure, NED to aircraft",
        "`[mount] gimbal`",
    ),
    Column("zenith_extinction_mag", "float", "mag", "extinction per air mass", _EXTINCTION),
    Column("sky_fraction", "float", "", "fraction of the image above the horizon, mid-exposure", "a horizon profile"),
    Column("bodies", "table", "", "Sun, Moon and planets on the image (below)", "`[sky] bodies = true`"),
    Column("satellites", "table", "", "the satellites on the image (below)", "`[sky] satellites`"),
    Column(
        "psf",
        "object",
        "",
        "its keys in `[sensor]`, and `gaussians`: [fraction of the flux, sigma in px] of each",
        "other than Gaussian stars",
    ),
    Column("colour", "object", "", "colours of the stars", _BAND),
    Column("colour.band", "string", "", "band of the sensor", _BAND),
    Column("colour.mosaic", "string", "", "mosaic of colour filters", _BAND),
    Column("colour.assumed_bv", "float", "mag", "B - V of stars without a known colour", _BAND),
    Column("colour.without_bv", "float[]", "", "`star_id` of the stars drawn with `assumed_bv`", _BAND),
    Column("cloud_transmission", "float", "", "mean over the sky on the image, mid-exposure; null without sky", _CLOUD),
    Column("sky_mag_arcsec2", "float", "mag/arcsec^2", "brightness of the sky on the optical axis", _NATURAL),
    Column("sun_altitude_deg", "float", "deg", "altitude of the Sun, without refraction", _NATURAL),
    Column("moon_altitude_deg", "float", "deg", "altitude of the Moon, with refraction", _NATURAL),
    Column("moon_separation_deg", "float", "deg", "angle between the Moon and the optical axis", _NATURAL),
    Column("moon_illuminated_fraction", "float", "", "lit fraction of the Moon's disc", _NATURAL),
    Column("sky_map", "string", "", "the image of relative sky brightness", "`[sensor] sky_map`"),
    Column("vignetting", "string", "", "model of the vignetting", "`[lens] vignetting`"),
    Column("flare_mean_dn", "float", "DN", "mean flare, sampled every 1/48 of the image's width", "`[flare]`"),
    Column("flare_max_dn", "float", "DN", "largest flare of these samples", "`[flare]`"),
    Column("pixel_pattern", "object", "", "the keys of the fixed pattern in `[sensor]`", "a fixed pattern"),
    Column("blooming", "object", "", "charge that saturated pixels spill", _BLOOMING),
    Column("blooming.along", "string", "", "direction of the spilling", _BLOOMING),
    Column("blooming.fraction", "float", "", "fraction of the charge that spills", _BLOOMING),
    Column("sensor", "object", "", "a sensor that counts electrons", _ELECTRONS),
    Column("sensor.noise", "string", "", '`"electrons"`', _ELECTRONS),
    Column("sensor.vmag_0_e_per_s", "float", "e/s", "electrons of a star of magnitude 0", _ELECTRONS),
    Column("sensor.dn_per_e", "float", "DN/e", "gain, with the analogue gain", _ELECTRONS),
    Column("sensor.black_level_dn", "float", "DN", "black level", _ELECTRONS),
    Column("sensor.read_noise_e", "float", "e", "read noise, rms", _ELECTRONS),
    Column("sensor.full_well_e", "float", "e", "full well", _ELECTRONS),
    Column("sensor.temperature_c", "float", "deg C", "temperature", _ELECTRONS),
    Column("sensor.sky_e", "float", "e", "mean signal of the sky in a pixel on the axis", _ELECTRONS),
    Column("sensor.dark_e", "float", "e", "mean dark signal of a pixel", _ELECTRONS),
    Column("output", "object", "", "its keys in `[output]`, or `align` and `shift_bits`", "`[output]`"),
    Column("analogue_gain", "float", "", "analogue gain that exposure control has set", "`[exposure] control`"),
    Column("flight", "string", "", "name of the flight", _SET),
    Column("sample", "int64", "", "number of the sample of the sweep", _SET),
    Column("settings", "object", "", "settings of the sample, by dotted key", _SET),
    Column("image_index", "int64", "", "number of the picture, as in CAMERA_IMAGE_CAPTURED", _COMMANDED),
    Column("command", "object", "", "the command that took it", _COMMANDED),
    Column("command.name", "string", "", "such as `IMAGE_START_CAPTURE`", _COMMANDED),
    Column("command.system", "int64", "", "MAVLink system that sent it", _COMMANDED),
    Column("command.component", "int64", "", "MAVLink component that sent it", _COMMANDED),
    Column("command.sequence", "int64", "", "the number that the sender gave the picture; 0 if none", _COMMANDED),
)

_STAR = (
    Column("star_id", "int32", "", "number in the catalogue: Harvard Revised (`bsc5`) or Hipparcos"),
    Column("vmag", "float", "mag", "V magnitude of the catalogue"),
    Column(
        "camera_mag",
        "float",
        "mag",
        "rendered magnitude: `vmag`, unless `sensor.star_brightness` gives the camera's own",
    ),
    Column(
        "x_px", "float", "px", "position at mid-exposure; null if it is behind the camera or below the horizon then"
    ),
    Column("y_px", "float", "px", "the same"),
    Column("centroid_x_px", "float", "px", "centroid of its signal over the whole exposure"),
    Column("centroid_y_px", "float", "px", "the same"),
    Column("start", "position", "px", "[x, y] when the shutter opens, or null as above", parts=_START_XY),
    Column("end", "position", "px", "[x, y] when it closes, or null as above", parts=_END_XY),
    Column(
        "peak_dn", "float", "DN", "amplitude of a star that stood still, above the sky; with extinction, below the air"
    ),
    Column("flux_dn", "float", "DN", "its sum; a lens keeps the flux everywhere, and the peak on its axis"),
    Column("in_frame", "float", "", "fraction of the exposure with its centre on the image, 0 to 1"),
    Column("saturated", "bool", "", "whether a pixel under its centre reaches the sensor's limit"),
    Column("trail_peak_dn", "float", "DN", "expected signal at the brightest point of its trail, above the sky"),
    Column(
        "snr", "float", "", "expected signal-to-noise ratio of its flux on the image, weighted with the trail's profile"
    ),
    Column("flux_e", "float", "e", "electrons on the image; `snr` then includes shot noise", _ELECTRONS),
    Column("mid_offset_s", "float", "s", "middle of the exposure of its row minus `utc_mid`", _ROLLING),
    Column(
        "exposed_s",
        "float",
        "s",
        "its length: T / (1 - v tau), v in rows per second, tau the time between rows",
        _ROLLING,
    ),
    Column("light_dn", "float", "DN", "flux that the star leaves: `flux_dn` times `exposed_s / duration_s`", _ROLLING),
    Column("segments", "segments", "px", "[start, end] of each short exposure, each an [x, y] or null", _STACK),
    Column("psf_sigma_px", "float", "px", "width of its core at mid-exposure", _WIDTH),
    Column("cloud_transmission_start", "float", "", "transmission of cloud as the shutter opens", _CLOUD),
    Column("cloud_transmission_mid", "float", "", "the same in the middle of the exposure", _CLOUD),
    Column("cloud_transmission_end", "float", "", "the same as the shutter closes", _CLOUD),
    Column("cloud_transmission_mean", "float", "", "the same over the exposure", _CLOUD),
    Column(
        "scintillation",
        "float",
        "",
        "mean relative brightness over the exposure, which is in the image",
        "`[sky] scintillation`",
    ),
    Column("transmission", "float", "", "transmission of the lens, over that on its axis", "`[lens] vignetting`"),
    Column("extinction_mag", "float", "mag", "extinction by the air", _EXTINCTION),
)

_BODY = (
    Column("name", "string", "", '`"Sun"`, `"Moon"` or a planet'),
    Column("vmag", "float", "mag", "V magnitude above the air, without earthshine"),
    Column("x_px", "float", "px", "position of the centre of its disc, as of a star"),
    Column("y_px", "float", "px", "the same"),
    Column("centroid_x_px", "float", "px", "mean position of the centre while it is on the image"),
    Column("centroid_y_px", "float", "px", "the same"),
    Column("start", "position", "px", "of the centre, as of a star", parts=_START_XY),
    Column("end", "position", "px", "of the centre, as of a star", parts=_END_XY),
    Column("flux_dn", "float", "DN", "as of a star"),
    Column("in_frame", "float", "", "as of a star, of the centre"),
    Column("saturated", "bool", "", "whether a pixel under the disc is saturated"),
    Column("azimuth_deg", "float", "deg", "from the aircraft, without refraction"),
    Column("altitude_deg", "float", "deg", "the same"),
    Column("distance_km", "float", "km", "the same"),
    Column("diameter_px", "float", "px", "of a circle of the same area as the disc"),
    Column("phase_angle_deg", "float", "deg", "angle between Sun and aircraft at the body"),
    Column("illuminated_fraction", "float", "", "lit fraction of the disc"),
    Column(
        "bright_limb_deg",
        "float",
        "deg",
        "direction to the bright limb on the image: right 0, down 90; null for the Sun",
    ),
    Column("mid_offset_s", "float", "s", "as of a star, of the centre", _ROLLING),
    Column("exposed_s", "float", "s", "as of a star, of the centre", _ROLLING),
    Column("light_dn", "float", "DN", "as of a star, of the centre", _ROLLING),
    Column("extinction_mag", "float", "mag", "extinction by the air", _EXTINCTION),
    Column("earthshine_vmag", "float", "mag", "of the Moon, `vmag` of the Earth's light on it", "`[sky] earthshine`"),
)

_SATELLITE = (
    Column("name", "string", "", "name in the file of elements"),
    Column("satellite_number", "int64", "", "number in the satellite catalogue"),
    *(column for column in _STAR if column.name != "star_id"),
    Column("range_km", "float", "km", "distance from the aircraft in the middle of the exposure"),
    Column("azimuth_deg", "float", "deg", "the same moment, without refraction"),
    Column("altitude_deg", "float", "deg", "the same"),
    Column("lit", "float", "", "mean light, by range, phase and the Earth's shadow, over that of `vmag`"),
)

_TABLES = {"frame": _FRAME, "star": _STAR, "body": _BODY, "satellite": _SATELLITE}
# In the order of a line of ``truth.jsonl``.  Effects of other packages may add keys of their own.
COLUMNS = tuple(replace(column, of=of) for of, columns in _TABLES.items() for column in columns)


def columns_of(of: str) -> tuple[Column, ...]:
    """Return the keys of a frame, star, body or satellite, in their order."""
    return tuple(column for column in COLUMNS if column.of == of)
