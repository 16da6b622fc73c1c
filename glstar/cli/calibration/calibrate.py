"""``glstar calibrate``: the simulator's sensor and camera from photographs of the stars."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from glstar.cli.calibration.settings import CalibrateOptions
from glstar.cli.flightoptions import ConfigFile
from glstar.cli.verbosity import with_verbosity
from glstar.errors import ConfigError


class _Channel(StrEnum):
    value = "value"
    red = "red"
    green = "green"
    blue = "blue"
    mean = "mean"


class _Lens(StrEnum):
    auto = "auto"
    none = "none"
    plumb_bob = "plumb_bob"
    rational = "rational"
    fisheye = "fisheye"


class _Criterion(StrEnum):
    median = "median"
    paper = "paper"


Images = Annotated[
    list[Path] | None,
    typer.Argument(help="Photographs of the stars by one camera: JPEG, PNG, TIFF or FITS.", show_default=False),
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
    typer.Option(help="Width of the view, deg, to 15 %.", min=1, max=180, show_default="the config's camera"),
]
ExposureTimes = Annotated[
    list[float] | None,
    typer.Option(help="Exposure, s; for several images once, or once per image.", show_default="as the file states"),
]
Times = Annotated[
    list[str] | None,
    typer.Option(help="UTC at mid-exposure, ISO 8601; for several images once per image.", show_default="unknown"),
]
Latitude = Annotated[
    float | None, typer.Option(help="Latitude, deg, north positive.", min=-90, max=90, show_default="unknown")
]
Longitude = Annotated[float | None, typer.Option(help="Longitude, deg, east positive.", show_default="unknown")]
Yaw = Annotated[
    float | None, typer.Option(help="Yaw of the aircraft, deg, right to some degrees.", show_default="unknown")
]
Pitch = Annotated[float | None, typer.Option(help="Pitch, deg.", show_default="unknown")]
Roll = Annotated[float | None, typer.Option(help="Roll, deg.", show_default="unknown")]
Log = Annotated[Path | None, typer.Option(help="A log with position and attitude at each --utc.", show_default="none")]
Labels = Annotated[Path | None, typer.Option(help="A CSV of known stars: x, y, star_id.", show_default="none")]
ColourChannel = Annotated[_Channel, typer.Option(help="Channel of a colour image.")]
BitDepth = Annotated[
    int | None,
    typer.Option(help="Bits of the converter, for raw images in 16 bits.", min=1, max=16, show_default="detected"),
]
BrightnessCriterion = Annotated[
    _Criterion, typer.Option(help="Reference brightness: the median of all stars, or the paper's single star.")
]
LensModel = Annotated[
    _Lens, typer.Option(help="OpenCV's lens model to fit to the stars; auto chooses the model that they justify.")
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


@with_verbosity
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
    channel: ColourChannel = _Channel.value,
    bit_depth: BitDepth = None,
    gamma: Gamma = None,
    criterion: BrightnessCriterion = _Criterion.median,
    lens: LensModel = _Lens.auto,
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

    Try: glstar calibrate ground.jpg --fov 60 --exposure 0.5 -o calibration.toml
    """
    if _calibrated_from_darks(images, darks, flats, output, bit_depth, as_json=as_json):
        return
    options = CalibrateOptions(
        config=config,
        fov_deg=fov,
        exposures_s=exposure,
        utc=utc,
        site_deg={"--lat": lat, "--lon": lon},
        attitude_deg={"--yaw": yaw, "--pitch": pitch, "--roll": roll},
        flight=flight,
        labels=labels,
        channel=channel.value,
        bit_depth=bit_depth,
        criterion=criterion.value,
        lens=lens.value,
        fit_lens=fit_lens,
        geometry_only=geometry_only,
        shape=shape,
        twin=twin,
        extinction=extinction,
        fit_readout=fit_readout,
        gamma=gamma,
    )
    _run(images or [], options, output, camera_out, as_json=as_json)


def _run(
    images: list[Path], options: CalibrateOptions, output: Path, camera_out: Path | None, *, as_json: bool
) -> None:
    """Calibrate from photographs, write the results and report."""
    _require_consistent(options, images)
    # OpenCV, SciPy and matplotlib are loaded only now.
    from glstar.calibrate import SharedGeometry  # noqa: PLC0415
    from glstar.cli.calibration.output import print_result  # noqa: PLC0415
    from glstar.cli.calibration.run import calibrate_images  # noqa: PLC0415

    result = calibrate_images(images, options, output, camera_out)
    if not options.twin or isinstance(result, SharedGeometry):
        print_result(result, output, as_json=as_json)
        return
    from glstar.cli.calibration.twin import write_twin_of  # noqa: PLC0415 - OpenGL

    write_twin_of(result, output, as_json=as_json)


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
    from glstar.cli.calibration.darks import calibrate_from_darks  # noqa: PLC0415 - OpenCV

    calibrate_from_darks(darks, flats, output, bit_depth, as_json=as_json)
    return True


def _require_consistent(options: CalibrateOptions, images: list[Path]) -> None:
    """Refuse options that contradict the number of images."""
    if options.twin and options.geometry_only:
        raise ConfigError("--twin needs the sensor, and --geometry-only leaves it out; give one of them")
    if options.twin and options.shape:
        raise ConfigError("--twin measures the shape of the stars too: leave --shape out")
    if options.fit_readout and (options.flight is None or not options.utc):
        raise ConfigError("--fit-readout needs --flight and --utc: how the aircraft turned while the rows were read")
    if options.fit_readout and options.twin:
        raise ConfigError("--twin draws one attitude for all rows: leave --fit-readout or --twin out")
    if options.extinction != "none":
        _require_extinction(options)
    if len(images) == 1:
        if options.fit_lens:
            raise ConfigError("--fit-lens needs several images: the lens of a single one is always fitted, see --lens")
    else:
        _require_several(options)


def _require_several(options: CalibrateOptions) -> None:
    """Refuse options that take one image."""
    if options.geometry_only and not options.fit_lens:
        raise ConfigError("--geometry-only of several images needs --fit-lens: one lens for all of them")
    if options.shape:
        raise ConfigError("--shape takes one image: calibrate the sharpest one with it")
    if options.twin:
        raise ConfigError("--twin takes one image: its sky is that of the one photograph")
    if options.gamma == "fit":
        raise ConfigError(
            "--gamma fit takes one image: fit it on that with the widest range of sky, and give the number"
        )
    if options.labels is not None:
        raise ConfigError("--labels belong to one image: leave them out, or calibrate the images one by one")
    if options.criterion == "paper":
        raise ConfigError("--criterion paper, eq. (38), takes one image; several use the median of all their stars")


def _require_extinction(options: CalibrateOptions) -> None:
    """Refuse an extinction that is no choice, or contradicts other options."""
    if options.extinction != "fit":
        try:
            known = 0 <= float(options.extinction) <= 10
        except ValueError:
            known = False
        if not known:
            raise ConfigError(
                f"--extinction is none, fit or a magnitude per air mass from 0 to 10, not {options.extinction!r}"
            )
    if options.twin or options.geometry_only:
        raise ConfigError("--extinction belongs to the brightness of the stars: leave --twin and --geometry-only out")
