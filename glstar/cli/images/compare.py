"""``glstar compare``: real images against simulated ones, star by star."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from glstar.cli.flightoptions import CAMERA_FLAGS, FlightFlags, with_flight_flags
from glstar.cli.reporting import echo_note, progress_bar
from glstar.errors import ConfigError, ImagesError

if TYPE_CHECKING:
    from glstar.compare import Alignment, Comparison, Search
    from glstar.config import Config


# Number of omitted images that are listed on the terminal.
_LISTED = 5


Paths = Annotated[
    list[Path],
    typer.Argument(
        metavar="[FLIGHT] IMAGES...",
        help="A flight log, then real images or folders of them; with --against the images alone.",
        show_default=False,
    ),
]
Output = Annotated[Path, typer.Option("-o", "--output", help="The directory for the report.", show_default=False)]
Against = Annotated[
    Path | None,
    typer.Option(help="A folder of simulated images to compare with, instead of a flight.", show_default="none"),
]
FitTimeOffset = Annotated[
    bool, typer.Option("--fit-time-offset", help="Fit the camera clock's offset to the trails first.")
]
FitMount = Annotated[bool, typer.Option("--fit-mount", help="Fit the mount's angles to the trails first.")]
FitReadout = Annotated[
    bool, typer.Option("--fit-readout", help="Fit the readout time of a rolling shutter to the trails first.")
]
ExposureTime = Annotated[
    float | None,
    typer.Option(help="Exposure time, s.", show_default="from the images, else from the config"),
]
TimeIs = Annotated[
    Literal["start", "middle", "end"],
    typer.Option(help="The instant of the exposure that an image's time refers to."),
]
Table = Annotated[
    Path | None,
    typer.Option(
        help="A CSV table of image times with the columns file and utc.",
        show_default="images.csv beside the images",
    ),
]
At = Annotated[
    str | None,
    typer.Option(
        help="Take the times of the images from the triggers of a camera in the log: the first image by name is that of"
        " the first trigger. camera, or of several the one that glstar info lists: camera:1, /cam0/camera_info.",
        show_default="the images' own times",
    ),
]
SearchAngle = Annotated[float, typer.Option(help="Largest error of the camera's direction, deg.", min=0.01, max=45)]
SearchTime = Annotated[
    float, typer.Option(help="Largest error of the camera's clock if it is fitted, s.", min=0, max=60)
]
LeastSignal = Annotated[float, typer.Option(help="Smallest signal-to-noise ratio of a trail.", min=3)]
MostStars = Annotated[int, typer.Option(help="Largest number of stars per image, the brightest first.", min=1)]
Seed = Annotated[int, typer.Option(help="Seed of the simulated noise.", min=0)]
AsJson = Annotated[bool, typer.Option("--json", help="Report as JSON.")]


@with_flight_flags(but=CAMERA_FLAGS)
def compare(
    paths: Paths,
    output: Output,
    flags: FlightFlags,
    against: Against = None,
    fit_time_offset: FitTimeOffset = False,
    fit_mount: FitMount = False,
    fit_readout: FitReadout = False,
    exposure: ExposureTime = None,
    time_is: TimeIs = "start",
    table: Table = None,
    at: At = None,
    search_angle: SearchAngle = 1.5,
    search_time: SearchTime = 1.0,
    least_signal: LeastSignal = 10.0,
    stars: MostStars = 60,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Compare real images with simulated ones, star by star: brightness, centroids, length and direction of trails.

    Writes plots, cutouts of the best and worst pairs, a page for a browser, a table and JSON into a directory; with
    --fit-time-offset, --fit-mount or --fit-readout also aligned.toml, the settings with the fitted values.

    Try: glstar compare flight.BIN photographs -c camera.toml -o compared --fit-time-offset --fit-mount
    """
    from glstar.compare import Search, write_comparison  # noqa: PLC0415 - SciPy, OpenCV

    search = Search(float(np.deg2rad(search_angle)), search_time, least_signal, stars)
    settings = flags.settings(**{"exposure.duration_s": exposure})
    if against is not None:
        if fit_time_offset or fit_mount or fit_readout:
            raise ConfigError(
                "--fit-time-offset, --fit-mount and --fit-readout need a flight; --against compares images without one"
            )
        comparison = _with_folder(settings, paths, against, search)
        about: dict[str, Any] = {"against": str(against)}
    else:
        if len(paths) < 2:
            raise ConfigError("compare needs a flight and images: glstar compare FLIGHT IMAGES... -o DIR")
        comparison = _with_flight(
            settings,
            paths,
            table,
            at,
            time_is,
            search,
            seed,
            own_length=exposure is None,
            fit=(fit_time_offset, fit_mount, fit_readout),
        )
        about = {"flight": str(paths[0])}
    written = write_comparison(comparison, output, **about)
    if comparison.alignment is not None:
        written.append(_write_aligned(settings, comparison, output))
    if as_json:
        typer.echo((output / "compare.json").read_text(encoding="utf-8"), nl=False)
    else:
        _print_summary(settings, comparison, written)


def _with_folder(settings: "Config", paths: list[Path], simulated: Path, search: "Search") -> "Comparison":
    from glstar.compare import compare_folders, image_files  # noqa: PLC0415 - SciPy, OpenCV

    with progress_bar("images") as on_step:
        return compare_folders(
            [file for path in paths for file in (image_files(path) if path.is_dir() else [path])],
            simulated,
            search_px=float(settings.camera().fx_px * np.tan(search.angle_rad)),
            least_signal=search.least_signal,
            most_stars=search.most_stars,
            on_step=on_step,
        )


def _with_flight(
    settings: "Config",
    paths: list[Path],
    table: Path | None,
    at: str | None,
    time_is: str,
    search: "Search",
    seed: int,
    *,
    own_length: bool,
    fit: tuple[bool, bool, bool],
) -> "Comparison":
    from glstar.camera.photofile import read_exif  # noqa: PLC0415 - only when images are read
    from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy, OpenCV
    from glstar.images import TimeReference, choose_images, triggered_images  # noqa: PLC0415 - OpenCV
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL

    flight = settings.open_flight(paths[0])
    if at is not None:
        images, problems = triggered_images(paths[1:], flight, at, delay_s=settings.exposure.at_delay_s), list[str]()
    else:
        images, problems = choose_images(paths[1:], table=table)
    if not images:
        first = f"; {problems[0]}" if problems else ""
        raise ImagesError(paths[1], f"holds no image with a time{first}; write images.csv with the columns file, utc")
    if turned := sum(read_exif(image.path).orientation > 1 for image in images):
        echo_note(f"note: EXIF turns {turned} of {len(images)} images for display; pixels are as the sensor read them")
    wanted = settings.exposure.starting_at(flight.attitude.first_s)
    with GLRenderer.headless() as renderer:
        job = FlightComparison(
            settings.simulator(flight),
            renderer,
            images,
            wanted,
            reference=TimeReference(time_is),
            own_length=own_length,
            search=search,
            problems=problems,
            seed=seed,
        )
        alignment = None
        if any(fit):
            with progress_bar("trails fitted") as on_fit:
                alignment = job.align(fit_time=fit[0], fit_mount=fit[1], fit_readout=fit[2], on_step=on_fit)
        with progress_bar("images") as on_step:
            return job.run(alignment, on_step=on_step)


def _write_aligned(settings: "Config", comparison: "Comparison", output: Path) -> Path:
    """Write the settings with the fitted values."""
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV
    from glstar.system.files import write_atomically  # noqa: PLC0415 - OpenCV

    fitted, path = comparison.alignment, output / "aligned.toml"
    assert fitted is not None
    aligned = settings.override(
        **{"flight.time_offset_s": settings.flight.time_offset_s - fitted.delay_s},
        **fitted.mount_keys,
        **_fitted_readout(settings, fitted),
    )
    with explain_disk_errors(path):
        write_atomically(path, aligned.to_toml().encode())
    return path


def _fitted_readout(settings: "Config", fitted: "Alignment") -> dict[str, Any]:
    """Return the keys of a fitted readout time; a negative one within its error is 0."""
    if not fitted.fitted_readout:
        return {}
    start = settings.exposure.starting_at(0.0)
    if fitted.opens_opposite:
        start = start.with_readout_s(fitted.readout_s)
    return {
        "exposure.readout_s": start.readout_s if fitted.opens_opposite else max(fitted.readout_s, 0.0),
        "exposure.readout": start.readout,
    }


def _print_summary(settings: "Config", comparison: "Comparison", written: list[Path]) -> None:
    """Print the result."""
    summary = comparison.summary
    typer.echo(
        f"{len(comparison.pairs)} stars paired on {_counted(len(comparison.images))} (times:"
        f" {comparison.time_sources}); differences are simulated minus real"
    )
    peak, centroid, own, trail = (summary[key] for key in ("peak", "centroid", "centroid_in_own_region", "trail"))
    if peak["pairs"]:
        typer.echo(
            f"peak intensity: mean error {peak['mean_error_dn']:+.2f} DN, mean absolute percentage error"
            f" {peak['mean_absolute_percentage_error']:.1f} %, that is {peak['magnitude_error']:.2f} mag;"
            f" {summary['saturated_pairs']} saturated pairs excluded"
        )
    typer.echo(
        f"centroid distance: mean {centroid['mean_px']:.3f} px, median {centroid['median_px']:.3f} px"
        f" (noise {centroid['noise_px']:.3f} px); each in its own region: mean {own['mean_px']:.3f} px,"
        f" median {own['median_px']:.3f} px; straight line: mean {own['baseline_mean_px']:.3f} px, median"
        f" {own['baseline_median_px']:.3f} px"
    )
    if trail["pairs"]:
        typer.echo(
            f"trails: length {trail['length_difference_px']['mean']:+.2f} px"
            f" ({trail['length_difference_percent']['mean']:+.1f} %), direction"
            f" {trail['direction_difference_deg']['mean']:+.2f} deg in the mean"
        )
    _print_alignment(settings, comparison)
    for note in comparison.notes:
        echo_note(f"note: {note}")
    for one in comparison.left_out[:_LISTED]:
        typer.echo(f"left out: {one.file}: {one.reason}", err=True)
    if len(comparison.left_out) > _LISTED:
        more = len(comparison.left_out) - _LISTED
        typer.echo(f"and {more} more left out; {written[0].parent / 'compare.json'} has the reasons", err=True)
    typer.echo(f"{written[0].parent}; plots: {', '.join(path.name for path in written if path.suffix == '.png')}")


def _counted(count: int) -> str:
    return "1 image" if count == 1 else f"{count} images"


def _print_alignment(settings: "Config", comparison: "Comparison") -> None:
    fitted = comparison.alignment
    if fitted is None:
        return
    if fitted.fitted_time:
        typer.echo(
            f"time offset {settings.flight.time_offset_s - fitted.delay_s:+.4f} s, to"
            f" {fitted.delay_std_s:.4f} s (camera's clock minus the log's)"
        )
    if fitted.fitted_mount:
        mount, turn, std = fitted.mount, np.rad2deg(fitted.turn_rad), np.rad2deg(fitted.turn_std_rad)
        angles = ", ".join(
            f"{name} {np.rad2deg(angle):.4f}"
            for name, angle in (("yaw", mount.yaw_rad), ("pitch", mount.pitch_rad), ("roll", mount.roll_rad))
        )
        typer.echo(
            f"mount {angles} deg: the camera is turned by {turn[0]:+.3f}, {turn[1]:+.3f}, {turn[2]:+.3f} deg about its"
            f" right, down and forward axes, to {std[0]:.3f}, {std[1]:.3f}, {std[2]:.3f} deg"
        )
    if fitted.fitted_readout:
        readout = _fitted_readout(settings, fitted)
        direction = (
            f"the rows open {readout['exposure.readout']}, not {settings.exposure.readout} as configured"
            if fitted.opens_opposite
            else f"rows open {settings.exposure.readout}"
        )
        typer.echo(
            f"readout time {1e3 * fitted.readout_s:+.2f} ms, to {1e3 * fitted.readout_std_s:.2f} ms ({direction})"
        )
    typer.echo(
        f"attitude error {np.rad2deg(fitted.attitude_std_rad):.3f} deg from image to image;"
        f" {fitted.stars} stars on {_counted(fitted.images)}"
    )
    for note in fitted.notes:
        echo_note(f"note: {note}")
