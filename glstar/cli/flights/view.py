"""``glstar view``: the flight-replay viewer, with the fit and the residuals of real images by `glstar.compare`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from glstar.cli.flightoptions import Flight, FlightFlags, flights_of, with_flight_flags
from glstar.cli.flights import windowoptions

if TYPE_CHECKING:
    from glstar.viewer.loop import Viewer
    from glstar.viewer.picture.fitting import FitRequest, FitResult, ResidualRequest, TrailResiduals

Start = Annotated[
    float | None, typer.Option(help="Initial time, s from the flight's first attitude.", show_default="0")
]
Sliding = Annotated[bool, typer.Option("--sliding", help="Show the exposure that ends at the play head, at any time.")]
Processed = Annotated[bool, typer.Option("--processed", help="Show the image that [output] makes of the raw one.")]
Images = Annotated[Path | None, typer.Option(help="A folder of real images to compare with.", show_default=False)]
Duration = Annotated[float | None, typer.Option(help="How long to play, s.", min=0.1, show_default=False)]
Answers = Annotated[
    Path | None,
    typer.Option(help="Answers of a navigator to draw (CSV or JSON lines); needs --answers-to.", show_default=False),
]
AnswersTo = Annotated[
    Path | None,
    typer.Option(help="The export of this flight that --answers are for, with its truth.", show_default=False),
]


def fit_images(request: "FitRequest", on_step: Callable[[int, int], None]) -> "FitResult":
    """Fit clock and mount to real images: see `glstar.viewer.picture.fitting.FitImages`.

    Raises ImagesError if the images determine neither the clock nor the mount; ConfigError if images are stacked.
    """
    from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL
    from glstar.viewer.picture.fitting import FitResult  # noqa: PLC0415 - OpenCV

    with GLRenderer.headless() as renderer:
        job = FlightComparison(
            request.simulator,
            renderer,
            request.images,
            request.exposure,
            reference=request.reference,
            own_length=request.own_length,
        )
        fitted = job.require_alignment(fit_time=request.fits_time, fit_mount=request.fits_mount, on_step=on_step)
        comparison = job.run(fitted, on_step=on_step)
    centroid = comparison.summary["centroid"]
    return FitResult(
        clock_change_s=-fitted.delay_s if fitted.fitted_time else None,
        clock_std_s=fitted.delay_std_s if fitted.fitted_time else None,
        mount_keys=fitted.mount_keys if fitted.fitted_mount else {},
        turn_rad=tuple(fitted.turn_rad.tolist()),
        turn_std_rad=tuple(fitted.turn_std_rad.tolist()),
        images=len(comparison.images),
        of=len(request.images),
        stars=fitted.stars,
        centroid_mean_px=centroid["mean_px"],
        centroid_median_px=centroid["median_px"],
        notes=fitted.notes,
    )


def measure_image(request: "ResidualRequest") -> "TrailResiduals":
    """Measure the trails of a real image: see `glstar.viewer.picture.fitting.MeasureImage`.

    Raises ImagesError if no trail is found; ConfigError if images are stacked.
    """
    from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL
    from glstar.viewer.picture.fitting import TrailResiduals  # noqa: PLC0415 - OpenCV

    flight = replace(request.simulator.flight, time_offset_s=request.ahead_s)
    with GLRenderer.headless() as renderer:
        comparison = FlightComparison(
            request.simulator.with_flight(flight),
            renderer,
            # The trails are those of the picture shown, at the image's time as it is.
            [replace(request.image, time=replace(request.image.time, grain_s=0.0))],
            request.exposure,
            reference=request.reference,
            own_length=request.own_length,
        ).run()
    pairs, [image] = comparison.pairs, comparison.images
    shift_px = np.array([[pair.shift_x_px, pair.shift_y_px] for pair in pairs])
    simulated_px = np.array([[pair.x_px, pair.y_px] for pair in pairs])
    return TrailResiduals(simulated_px - shift_px, shift_px, image.predicted, comparison.figures)


@with_flight_flags()
def view(
    flight: Flight = None,
    *,
    flags: FlightFlags,
    start: Start = None,
    sliding: Sliding = False,
    show: windowoptions.Show = None,
    processed: Processed = False,
    images: Images = None,
    answers: Answers = None,
    answers_to: AnswersTo = None,
    size: windowoptions.Size = None,
    screenshot: windowoptions.Screenshot = None,
    duration: Duration = None,
    stats: windowoptions.Stats = None,
    leave: Annotated[bool, typer.Option("--exit", help="Exit afterwards.")] = False,
    headless: windowoptions.Headless = False,
) -> None:
    """Replay a flight in a window, as the camera would have recorded it.

    F1 lists the keys. A log, settings (.toml) or a folder of real images can be dropped onto the window.

    Try: glstar view flight.BIN
    """
    settings = flags.settings()
    scripted = screenshot is not None or duration is not None
    _refuse_idle(headless=headless, scripted=scripted)
    _refuse_lone_options(answers, answers_to, stats, duration)
    windowoptions.require_window_libraries()
    from glstar.cli.flights.navigatoranswers import placed_answers  # noqa: PLC0415 - the link
    from glstar.viewer.flight.playhead import Mode  # noqa: PLC0415 - imgui, only if a window is opened
    from glstar.viewer.loop import Script, Viewer  # noqa: PLC0415 - imgui, only if a window is opened

    overlays, asks = windowoptions.overlays_of(show), not (scripted or leave)
    memory = windowoptions.memory_of("viewer") if asks and not headless else None
    surface = windowoptions.surface_of(windowoptions.size_of(size, memory), headless=headless)
    try:
        layout = None if headless or scripted else windowoptions.layout_of("viewer")
        with Viewer(surface, settings, layout=layout, memory=memory) as viewer:
            _enable_measurements(viewer)
            viewer.session.shows_processed = processed
            script = Script(start, Mode.SLIDING if sliding else None, overlays, screenshot, duration, asks)
            is_scripted = script != Script(asks=True)
            if is_scripted or flight is not None or images is not None or settings.synthetic.description is not None:
                viewer.open(flights_of(settings, None if flight is None else [flight])[0])
            if answers is not None and answers_to is not None:
                viewer.session.navigator.answers = placed_answers(answers, answers_to)
            if images is not None:
                viewer.session.comparison.open(images)
            report = viewer.play(script) if is_scripted else {}
            if stats is not None:
                windowoptions.write_stats(stats, report)
            _say_if_raw(viewer)
            if not (leave or headless):
                viewer.run()
            if memory is not None:
                memory.size = surface.window_size
    finally:
        surface.close()


def _enable_measurements(viewer: "Viewer") -> None:
    """Give the window the functions of ``glstar compare`` and ``glstar camera calibrate``."""
    viewer.session.comparison.fit_images = fit_images
    viewer.session.comparison.residuals.measure = measure_image
    viewer.interface.calibration.calibrate = windowoptions.calibrate_photo


def _say_if_raw(viewer: "Viewer") -> None:
    """Say why a processed image was asked for and is not shown."""
    from glstar.viewer.picture.simulated import why_not_processed  # noqa: PLC0415 - OpenCV

    session = viewer.session
    if session.shows_processed and session.scene is not None and (reason := why_not_processed(session.scene)):
        typer.echo(f"note: the image shown is raw: {reason}", err=True)


def _refuse_idle(*, headless: bool, scripted: bool) -> None:
    """Refuse to run without a window and without a script."""
    if headless and not scripted:
        raise typer.BadParameter(
            "without a window there is nothing to do but --screenshot or --duration", param_hint="--headless"
        )


def _refuse_lone_options(
    answers: Path | None, answers_to: Path | None, stats: Path | None, duration_s: float | None
) -> None:
    """Refuse answers without their frames, frames without answers, and statistics of nothing."""
    if stats is not None and duration_s is None:
        raise typer.BadParameter("--stats needs --duration SECONDS", param_hint="--stats")
    if (answers is None) != (answers_to is None):
        raise typer.BadParameter(
            "--answers FILE and --answers-to EXPORT belong together: an answer names a frame of an export",
            param_hint="--answers" if answers_to is None else "--answers-to",
        )
