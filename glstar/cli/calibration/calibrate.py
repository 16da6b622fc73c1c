"""``glstar camera calibrate``: the simulator's sensor and camera from photographs of the stars."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from glstar.cli.flightoptions import ConfigFile
from glstar.errors import ConfigError

Images = Annotated[
    list[Path] | None,
    typer.Argument(help="Photographs of stars by one camera: JPEG, PNG, TIFF, FITS, raw or HEIC.", show_default=False),
]
Darks = Annotated[
    Path | None,
    typer.Option(
        help="Directory of dark frames, instead of photographs: black level, noise, hot pixels.", show_default="none"
    ),
]
Flats = Annotated[
    Path | None,
    typer.Option(help="With --darks, flat fields in pairs of one brightness: the gain.", show_default="none"),
]
Output = Annotated[
    Path, typer.Option("-o", "--output", help="The calibration to write; star list, report and JSON go beside it.")
]
Fov = Annotated[
    float | None,
    typer.Option(help="Width of the view, deg, to 15 %.", min=1, max=300, show_default="the config's camera"),
]
ExposureTimes = Annotated[
    list[float] | None,
    typer.Option(help="Exposure, s; for several images once, or once per image.", show_default="as the file states"),
]
Times = Annotated[
    list[str] | None,
    typer.Option(help="UTC at mid-exposure, ISO 8601; for several images once per image.", show_default="as EXIF says"),
]
Latitude = Annotated[
    float | None, typer.Option(help="Latitude, deg, north positive.", min=-90, max=90, show_default="as EXIF says")
]
Longitude = Annotated[float | None, typer.Option(help="Longitude, deg, east positive.", show_default="as EXIF says")]
Yaw = Annotated[
    float | None, typer.Option(help="Yaw of the aircraft, deg, right to some degrees.", show_default="unknown")
]
Pitch = Annotated[float | None, typer.Option(help="Pitch, deg.", show_default="unknown")]
Roll = Annotated[float | None, typer.Option(help="Roll, deg.", show_default="unknown")]
Log = Annotated[Path | None, typer.Option(help="A log with position and attitude at each --utc.", show_default="none")]
Labels = Annotated[Path | None, typer.Option(help="A CSV of known stars: x, y, star_id.", show_default="none")]
ColourChannel = Annotated[
    Literal["value", "red", "green", "blue", "mean"], typer.Option(help="Channel of a colour image.")
]
BitDepth = Annotated[
    int | None,
    typer.Option(help="Bits of the converter, for raw images in 16 bits.", min=1, max=16, show_default="detected"),
]
BrightnessCriterion = Annotated[
    Literal["median", "paper"],
    typer.Option(help="Reference brightness: the median of all stars, or the paper's single star."),
]
LensModel = Annotated[
    Literal["auto", "none", "plumb_bob", "rational", "fisheye"],
    typer.Option(help="OpenCV's lens model to fit to the stars; auto chooses the model that they justify."),
]
FitLens = Annotated[
    bool, typer.Option("--fit-lens", help="Fit one lens to all images together, with an attitude for each.")
]
FitReadout = Annotated[
    bool,
    typer.Option(
        "--fit-readout",
        help="Fit the readout time of a rolling shutter to the stars; needs --flight, --utc and a turning aircraft.",
    ),
]
GeometryOnly = Annotated[
    bool,
    typer.Option(
        "--geometry-only",
        help="Camera and attitude only, no sensor: for stars that are blurred or saturated; needs no --exposure.",
    ),
]
Shape = Annotated[
    bool,
    typer.Option("--shape", help="Fit the shape of the stars too: Moffat wings, ellipticity, growth off axis."),
]
Twin = Annotated[
    bool,
    typer.Option(
        "--twin",
        help="Measure all that the image shows (sky, noise, shape, colour, vignetting), simulate it, and compare.",
    ),
]
ExtinctionTaken = Annotated[
    str,
    typer.Option(
        "--extinction",
        help="Brightness above the air: 'fit' the extinction to the stars, or mag per air mass, such as 0.28.",
    ),
]
Gamma = Annotated[
    str | None,
    typer.Option(
        help="Tone curve of processed images (JPEG): linear, srgb, rpi, a number such as 2.2, or 'fit' to the noise.",
        show_default="fit with --twin, else linear",
    ),
]
CameraOut = Annotated[
    Path | None,
    typer.Option(help="Also write the camera as a file for [camera] file, ROS and OpenCV.", show_default="none"),
]
AsJson = Annotated[bool, typer.Option("--json", help="Report as JSON.")]


def calibrate(
    images: Images = None,
    output: Output = Path("calibration.toml"),
    config: ConfigFile = None,
    fov: Fov = None,
    exposure: ExposureTimes = None,
    utc: Times = None,
    lat: Latitude = None,
    lon: Longitude = None,
    yaw: Yaw = None,
    pitch: Pitch = None,
    roll: Roll = None,
    flight: Log = None,
    labels: Labels = None,
    channel: ColourChannel = "value",
    bit_depth: BitDepth = None,
    gamma: Gamma = None,
    criterion: BrightnessCriterion = "median",
    lens: LensModel = "auto",
    fit_lens: FitLens = False,
    fit_readout: FitReadout = False,
    geometry_only: GeometryOnly = False,
    shape: Shape = False,
    twin: Twin = False,
    extinction: ExtinctionTaken = "none",
    camera_out: CameraOut = None,
    darks: Darks = None,
    flats: Flats = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate the simulator's sensor from photographs of the stars: brightness, sharpness, sky and noise.

    Stars are identified by attitude, labels or pattern.  Several images also measure the magnitude of each star.

    Try: glstar camera calibrate ground.jpg --fov 60 --exposure 0.5 -o calibration.toml
    """
    if _calibrated_from_darks(images, darks, flats, output, bit_depth, as_json=as_json):
        return
    _require_possible_twin(twin, images or [], geometry_only, shape, fit_readout, extinction)
    from glstar.calibrate import pipeline  # noqa: PLC0415 - OpenCV, SciPy
    from glstar.cli.calibration import output as reports  # noqa: PLC0415 - OpenCV, SciPy

    with reports.showing_progress() as (on_step, on_note):
        result = pipeline.calibrate_photographs(
            images or [],
            config=config,
            fov_deg=fov,
            exposure_s=exposure,
            utc=utc,
            site_deg=_all_or_none({"--lat": lat, "--lon": lon}),
            attitude_deg=_all_or_none({"--yaw": yaw, "--pitch": pitch, "--roll": roll}),
            flight=flight,
            labels=labels,
            channel=channel,
            bit_depth=bit_depth,
            gamma=gamma or (None if twin else "linear"),
            criterion=criterion,
            lens=lens,
            fit_lens=fit_lens,
            fit_readout=fit_readout,
            geometry_only=geometry_only,
            shape=shape,
            extinction=extinction,
            on_step=on_step,
            on_note=on_note,
        )
    reports.write_and_print(result, output, camera_out, images or [], twin=twin, as_json=as_json)


def _calibrated_from_darks(
    images: list[Path] | None,
    darks: Path | None,
    flats: Path | None,
    output: Path,
    bit_depth: int | None,
    *,
    as_json: bool,
) -> bool:
    """Calibrate from dark frames and return True if they are given; refuse them with photographs, and neither."""
    if output.suffix.lower() != ".toml":
        raise typer.BadParameter(f"{output} must end with .toml", param_hint="--output")
    if darks is None and flats is not None:
        raise typer.BadParameter("needs --darks too", param_hint="--flats")
    if darks is not None and images:
        raise typer.BadParameter("is given with photographs of stars; calibrate them separately", param_hint="--darks")
    if darks is None and not images:
        raise typer.BadParameter("give photographs of the stars, or --darks", param_hint="IMAGES")
    if darks is None:
        return False
    from glstar.cli.calibration.output import calibrate_from_darks  # noqa: PLC0415 - OpenCV, SciPy

    calibrate_from_darks(darks, flats, output, bit_depth, as_json=as_json)
    return True


def _require_possible_twin(
    twin: bool, images: list[Path], geometry_only: bool, shape: bool, fit_readout: bool, extinction: str
) -> None:
    """Refuse options that contradict ``--twin``, if it is given."""
    if not twin:
        return
    if geometry_only:
        raise ConfigError("--twin needs the sensor, and --geometry-only leaves it out; give one of them")
    if shape:
        raise ConfigError("--twin measures the shape of the stars too: leave --shape out")
    if fit_readout:
        raise ConfigError("--twin draws one attitude for all rows: leave --fit-readout or --twin out")
    if extinction != "none":
        raise ConfigError("--extinction belongs to the brightness of the stars: leave --twin and --geometry-only out")
    if len(images) > 1:
        raise ConfigError("--twin takes one image: its sky is that of the one photograph")


def _all_or_none(options: dict[str, float | None]) -> tuple[float, ...] | None:
    """Return the values of options that go together, or None if none was given."""
    values = tuple(value for value in options.values() if value is not None)
    if 0 < len(values) < len(options):
        missing = [name for name, value in options.items() if value is None]
        raise ConfigError(f"{' and '.join(missing)} missing; {', '.join(options)} go together")
    return values or None
