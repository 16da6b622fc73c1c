"""``glstar live``: the sky of a flight that a telemetry link receives, in a window or as frames."""

import json
import shlex
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from glstar.cli.dispatch import inner_words
from glstar.cli.flightoptions import FlightFlags, Format, completion, with_flight_flags
from glstar.cli.flights import windowoptions
from glstar.cli.flights.linkoptions import CameraOptions, Injection, InjectionOptions, with_link_options
from glstar.cli.flights.liveoutputs import LiveOutputs, with_live_outputs
from glstar.cli.flights.navigatoranswers import InjectedAnswers, ShownAnswers
from glstar.cli.reporting import echo_note
from glstar.config import Config
from glstar.errors import LinkError, LinkTimeoutError
from glstar.link import Clock, Endpoint, Link, LinkStatus, Recorder, Truth, serial_ports
from glstar.link.history import SIMULATOR_NAMES
from glstar.link.packets import dialect
from glstar.link.status import GIMBAL_LACK
from glstar.system.process import exit_on_interrupt

if TYPE_CHECKING:
    from glstar.export.live import LiveReport


LinkName = Annotated[
    str | None,
    typer.Argument(
        help="Where the vehicle is: /dev/ttyUSB0,57600, COM14,57600, udpin:127.0.0.1:14550, udpout:HOST:14550,"
        " tcp:HOST:5760.",
        show_default="a list of the serial ports",
        autocompletion=completion(lambda: inner_words("live")),
    ),
]
ExportTo = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        "--export",
        help="A new directory for frames and truth, written as they happen.",
        show_default=False,
    ),
]
Record = Annotated[Path | None, typer.Option(help="Record every packet: a new .tlog.", show_default=False)]
ExposureLength = Annotated[
    float | None, typer.Option(help="Duration of each exposure, s.", show_default="0.5, or the config's")
]
Interval = Annotated[
    float | None,
    typer.Option(help="Time from one exposure's start to the next, s.", show_default="3, or the config's"),
]
Duration = Annotated[float | None, typer.Option(help="When to stop, s.", min=0.0, show_default="when you stop it")]
BufferLength = Annotated[
    float, typer.Option(help="How far you can go back in the flight, minutes.", min=0.1, max=120.0)
]
Rate = Annotated[
    float | None,
    typer.Option(help="Attitudes per second to ask for.", min=1, max=1000, show_default="what the link can carry"),
]
UtcNow = Annotated[bool, typer.Option("--utc-now", help="Use the computer's clock as UTC if the link sends none.")]
Seed = Annotated[int, typer.Option(help="Seed of the noise.", min=0)]
Force = Annotated[bool, typer.Option("--force", help="Remove the frames that are in the directory.")]
TruthOf = Annotated[
    Truth,
    typer.Option(
        help="What the sky is drawn from: the autopilot's estimate, or a simulator's own state (SIM_STATE,"
        " HIL_STATE_QUATERNION or SIMSTATE); nav.jsonl of --export then has the estimate.",
    ),
]
ClockOf = Annotated[
    Clock,
    typer.Option(
        help="When frames end: arrival, at the latest attitude; vehicle, at whole multiples of --every by the vehicle's"
        " clock, for simulators that are faster than real time, paused or set back.",
    ),
]
Answers = Annotated[
    str | None,
    typer.Option(
        help="Answers to show in the window or to --inject: a file that a solver appends JSON lines to; - is the"
        " standard input; zmq://HOST:PORT receives them of glstar live answer and of other programs.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Report as JSON.")]

# Interval at which a link that is only recorded is polled for events, s.
_POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class _WindowOptions:
    """Options of the window: show it, save a screenshot, print statistics, show answers."""

    show: str | None
    size: str | None
    screenshot: Path | None
    stats: Path | None
    headless: bool
    answers: str | None


@dataclass(frozen=True, slots=True)
class _ExportOptions:
    """Outputs of frames."""

    directory: Path | None
    outputs: LiveOutputs
    image_format: Any
    seed: int
    force: bool

    @classmethod
    def of(cls, directory: Path | None, outputs: LiveOutputs, *others: Any) -> Self | None:
        """Return the options; None if no frames are asked for."""
        return None if directory is None and not outputs.has_any else cls(directory, outputs, *others)


# These options apply to logs only.
@with_link_options
@with_live_outputs
@with_flight_flags(but={"attitude", "boot", "columns", "position", "vehicle"})
def live(
    link: LinkName = None,
    *,
    export: ExportTo = None,
    outputs: LiveOutputs,
    record: Record = None,
    exposure: ExposureLength = None,
    every: Interval = None,
    duration: Duration = None,
    buffer: BufferLength = 10.0,
    rate: Rate = None,
    flags: FlightFlags,
    utc_now: UtcNow = False,
    truth: TruthOf = "estimator",
    clock: ClockOf = "arrival",
    injected: InjectionOptions,
    answers: Answers = None,
    commanded: CameraOptions,
    format_: Format = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
    show: windowoptions.Show = None,
    size: windowoptions.Size = None,
    screenshot: windowoptions.Screenshot = None,
    stats: windowoptions.Stats = None,
    headless: windowoptions.Headless = False,
) -> None:
    """Show what the camera on an aircraft sees now, from its telemetry link, in a window; or write it as frames.

    Try: glstar live /dev/ttyUSB0,57600 --record flight.tlog
    """
    if link is None:
        _list_ports(as_json=as_json)
        return
    _refuse_file(link)
    window = _WindowOptions(show, size, screenshot, stats, headless, answers)
    frames = _ExportOptions.of(export, outputs, format_, seed, force)
    _refuse_contradictions(window, clock, exports=frames is not None, records=record is not None, duration_s=duration)
    with exit_on_interrupt():
        _import_libraries(draws=frames is not None)
        outputs.check()
    windowoptions.size_of(size)
    settings = flags.settings(**{"exposure.duration_s": exposure, "exposure.interval_s": every})
    endpoint = Endpoint.parse(link)
    injection = injected.injection(endpoint, answers, exports=frames is not None)
    with ExitStack() as stack:
        camera = stack.enter_context(commanded.component(settings, export, outputs, format_, every))
        recorder = None if record is None else stack.enter_context(Recorder(record))
        senders = {"camera": camera, "injector": None if injection is None else injection.injector}
        reception = {"rate_hz": rate, "keep_s": 60.0 * buffer, "recorder": recorder, "truth": truth, "clock": clock}
        opened = stack.enter_context(_open(endpoint, settings, utc_now=utc_now, **reception, **senders))
        echo_note(f"listening on {endpoint.text}; Ctrl-C stops")
        start_s = time.monotonic()
        report = _follow(opened, settings, window, frames, injection, duration)
        elapsed_s = time.monotonic() - start_s
        status = opened.status()
    _refuse_silence(status, elapsed_s)
    if status.lacks_gimbal and report.get("drawn") == 0:
        raise LinkError(status.endpoint, f"nothing was drawn: {GIMBAL_LACK}")
    summary = {"seconds": round(elapsed_s, 3), **_link_summary(status), **report}
    typer.echo(json.dumps(summary) if as_json else _text(summary))


def _refuse_contradictions(
    window: _WindowOptions, clock: Clock, *, exports: bool, records: bool, duration_s: float | None
) -> None:
    if clock == "vehicle" and not exports:
        message = "times frames: add --export, --latest-frame, --video or --foxglove"
        raise typer.BadParameter(message, param_hint="--clock")
    of_window = window.screenshot is not None or window.stats is not None
    if exports and (of_window or window.show is not None or window.headless):
        raise typer.BadParameter(
            "--export, --latest-frame, --video and --foxglove open no window: --show, --screenshot, --stats belong to"
            " a window"
        )
    if window.headless and not (records or of_window):
        raise typer.BadParameter(
            "without a window there is nothing to do but --record, --export, --latest-frame, --video, --foxglove or"
            " --screenshot",
            param_hint="--headless",
        )
    if window.answers is not None and window.headless and not (exports or of_window):
        raise typer.BadParameter("are shown in a window, or sent with --inject", param_hint="--answers")
    if window.stats is not None and duration_s is None:
        raise typer.BadParameter("--stats needs --duration SECONDS", param_hint="--stats")


def _import_libraries(*, draws: bool) -> None:
    """Import what takes long enough to be interrupted, before anything is opened."""
    dialect()  # pymavlink
    if draws:
        import glstar.export.live  # noqa: PLC0415 - OpenCV
        import glstar.render.opengl  # noqa: F401, PLC0415 - OpenGL, only if frames are drawn


def _follow(
    link: Link,
    settings: Config,
    window: _WindowOptions,
    frames: _ExportOptions | None,
    injection: Injection | None,
    duration_s: float | None,
) -> dict[str, object]:
    """Export, record or show the link, and return the report."""
    if frames is not None:
        return _export(link, settings, frames, injection, duration_s)
    if window.headless and window.screenshot is None and window.stats is None:
        return _only_record(link, duration_s)
    return _show_window(link, settings, window, duration_s)


def _refuse_silence(status: LinkStatus, elapsed_s: float) -> None:
    """Raise an error if nothing was received, or nothing that the sky is drawn from."""
    if not status.packets:
        raise LinkTimeoutError(status.endpoint, elapsed_s)
    if status.lacks_simulator:
        raise LinkError(
            status.endpoint,
            f"sent no {SIMULATOR_NAMES}, so that there is no truth to draw; is it a simulator?"
            " --truth estimator draws the estimated attitude",
        )


def _open(endpoint: Endpoint, settings: Config, **options: Any) -> Link:
    on_gimbal = settings.gimbal.mode == "log"
    return Link(endpoint, settings.flight.options, sysid=settings.flight.sysid, on_gimbal=on_gimbal, **options)


def _show_window(link: Link, settings: Config, window: _WindowOptions, duration_s: float | None) -> dict[str, object]:
    """Show the link in the viewer's window, and return the report of its images."""
    windowoptions.require_window_libraries()
    from glstar.viewer.loop import Script, Viewer  # noqa: PLC0415 - imgui, only if a window is opened

    overlays = windowoptions.overlays_of(window.show)
    script = Script(overlays=overlays, screenshot=window.screenshot, play_s=duration_s)
    report: dict[str, Any] = {}
    with ExitStack() as stack:
        surface = windowoptions.surface_of(windowoptions.size_of(window.size), headless=window.headless)
        stack.callback(surface.close)
        layout = windowoptions.layout_of("live") if script == Script(overlays=overlays) else None
        viewer = stack.enter_context(Viewer(surface, settings, layout=layout))
        viewer.follow(link, on_event=_log)
        viewer.interface.calibration.calibrate = windowoptions.calibrate_photo
        if overlays is not None:
            viewer.session.shown_overlays = set(overlays)
        if window.answers is not None:
            show = viewer.session.navigator.add
            stack.enter_context(ShownAnswers(window.answers, settings, show, _log))
        with suppress(KeyboardInterrupt):
            if script.screenshot is not None or script.play_s is not None:
                report = viewer.play(script)
            if window.stats is not None:
                windowoptions.write_stats(window.stats, report)
            if duration_s is None and not window.headless:
                viewer.run()
    return _image_summary(report)


def _export(
    link: Link, settings: Config, frames: _ExportOptions, injection: Injection | None, duration_s: float | None
) -> dict[str, object]:
    """Write frames as they happen, and return the report."""
    # OpenCV and OpenGL, only if frames are drawn.
    from glstar.export.imagefiles.formats import fit_format  # noqa: PLC0415
    from glstar.export.live import LiveExport  # noqa: PLC0415
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415

    with ExitStack() as stack:
        renderer = stack.enter_context(GLRenderer.headless())
        _, sensor = fit_format(frames.image_format, settings.sensor(), summed=settings.exposure.signal_factor)
        opened = stack.enter_context(frames.outputs.opened(settings, sensor))
        job = LiveExport(
            settings,
            link,
            directory=frames.directory,
            output=opened.all,
            preview=None if link.camera is None else opened.viewers,
            image_format=frames.image_format,
            seed=frames.seed,
            command=shlex.join(["glstar", *sys.argv[1:]]),
        )
        if injection is not None:
            received = InjectedAnswers(
                injection.answers, injection.injector, job.exposures, settings, _log, on_failure=job.stop
            )
            stack.enter_context(received)
        report = job.run(renderer, duration_s=duration_s, force=frames.force, on_event=_log)
        injector = None if injection is None else injection.injector
        injected = {} if injector is None else {"injected": injector.sent, "not_injected": injector.refused}
        late = {"late": report.late} if link.clock == "vehicle" else {}
        return {**_export_summary(report), **late, **injected}


def _only_record(link: Link, duration_s: float | None) -> dict[str, object]:
    """Wait while the link records, and log its events."""
    last_event, end_s = 0, None if duration_s is None else time.monotonic() + duration_s
    with suppress(KeyboardInterrupt):
        while link.failure is None and (end_s is None or time.monotonic() < end_s):
            for event in link.events(last_event):
                last_event = event.number
                _log(event.message)
            time.sleep(_POLL_S)
    return {}


def _log(message: str) -> None:
    echo_note(f"{time.strftime('%H:%M:%S')} {message}")


def _link_summary(status: LinkStatus) -> dict[str, object]:
    return {
        "vehicle": status.vehicle,
        "packets": status.packets,
        "lost": status.lost,
        "utc": status.utc_source,
        "recorded_bytes": status.recorded_bytes,
    }


def _image_summary(report: dict[str, Any]) -> dict[str, object]:
    """Return the summary of `Viewer.play`; empty without a report."""
    if not report:
        return {}
    latency_ms = report["link"]["latency_ms"]
    latency_s = {name: None if ms is None else round(ms / 1e3, 4) for name, ms in latency_ms.items()}
    return {
        "drawn": report["link"]["images"],
        "directory": None,
        "latency_median_s": latency_s["median"],
        "latency_95_s": latency_s["p95"],
    }


def _export_summary(report: "LiveReport") -> dict[str, object]:
    return {
        "directory": None if report.directory is None else str(report.directory),
        "drawn": report.drawn,
        "skipped": dict(Counter(frame.reason for frame in report.skipped)),
        "latency_median_s": _rounded(report.latency_quantile_s(0.5)),
        "latency_95_s": _rounded(report.latency_quantile_s(0.95)),
    }


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 4)


def _text(summary: dict[str, object]) -> str:
    lines = [
        f"{summary['packets']} packets in {summary['seconds']} s, {summary['lost']} lost;"
        f" UTC: {summary['utc'] or 'unknown'}"
    ]
    if summary["recorded_bytes"]:
        lines.append(f"{summary['recorded_bytes']} bytes recorded")
    if "drawn" in summary:
        directory = summary["directory"]
        lines.append(f"{summary['drawn']} frames drawn" + (f": {directory}" if directory else ""))
    if "injected" in summary:
        refused = f", {summary['not_injected']} refused" if summary["not_injected"] else ""
        lines.append(f"{summary['injected']} positions sent to the autopilot{refused}")
    if summary.get("late"):
        lines.append(f"{summary['late']} left out: the vehicle's clock is faster than frames are drawn")
    skipped = summary.get("skipped")
    if isinstance(skipped, dict):
        lines += [f"{count} skipped, their exposures met {reason}" for reason, count in skipped.items()]
    if summary.get("latency_median_s") is not None:
        lines.append(
            f"latest attitude to frame: median {summary['latency_median_s']} s, 95 % under {summary['latency_95_s']} s"
        )
    return "\n".join(lines)


def _refuse_file(link: str) -> None:
    """Refuse the path of a flight log, which is easily given instead of a link."""
    if Path(link).is_file():
        raise LinkError(link, f"is a file, not a link; replay a flight log with 'glstar view {link}'")


def _list_ports(*, as_json: bool) -> None:
    """List the serial ports, and the forms of a link."""
    ports = serial_ports()
    if as_json:
        typer.echo(json.dumps([{"device": port.device, "description": port.description} for port in ports]))
        return
    if ports:
        typer.echo("serial ports:")
        for port in ports:
            typer.echo(f"  {port.device}  {port.description}")
    else:
        typer.echo("no serial port: nothing is plugged in")
    example = ports[0].device if ports else "/dev/ttyUSB0"
    typer.echo(
        "\nglstar live LINK, where LINK is\n"
        f"  {example},57600          a radio; an autopilot's USB port needs no rate\n"
        "  udpin:127.0.0.1:14550        where MAVProxy or QGroundControl forward to (0.0.0.0: from other computers)\n"
        "  udpout:192.168.1.7:14550     a vehicle that waits for the first packet\n"
        "  tcp:127.0.0.1:5760           a simulator\n"
        "No vehicle at hand? glstar live replay FLIGHT udpout:127.0.0.1:14550 plays one."
    )
