"""``glstar live``: the sky of a flight that is still going on, from a telemetry link: in a window, or as frames."""

import json
import shlex
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from glstar.cli.flightoptions import FlightFlags, Format, with_flight_flags
from glstar.cli.windowoptions import (
    Headless,
    Screenshot,
    Show,
    Size,
    Stats,
    layout_of,
    overlays_of,
    size_of,
    surface_of,
    write_stats,
)
from glstar.errors import LinkError, LinkTimeoutError
from glstar.export.latestframe import LatestFrameWriter
from glstar.link import Endpoint, Link, Recorder, serial_ports

if TYPE_CHECKING:
    from glstar.export.liveexport import LiveReport
    from glstar.viewer.loop import Script, Viewer

__all__ = ["live"]


# What is received is all the attitude there is.
@with_flight_flags(but={"attitude", "boot"})
def live(
    link: Annotated[
        str | None,
        typer.Argument(
            help="Where the vehicle is: /dev/ttyUSB0,57600, COM14,57600, udpin:127.0.0.1:14550, udpout:HOST:14550,"
            " tcp:HOST:5760.",
            show_default="a list of the serial ports",
        ),
    ] = None,
    *,
    export: Annotated[
        Path | None, typer.Option(help="A new directory for frames and truth, as they happen.", show_default=False)
    ] = None,
    latest_frame: Annotated[
        str | None,
        typer.Option(
            help="Hand the newest frame to another process: shm:NAME, or a file; one writer a name.", show_default=False
        ),
    ] = None,
    record: Annotated[Path | None, typer.Option(help="Record every packet: a new .tlog.", show_default=False)] = None,
    exposure: Annotated[
        float | None, typer.Option(help="How long each exposure is, s.", show_default="0.5, or the config's")
    ] = None,
    every: Annotated[
        float | None,
        typer.Option(help="From one exposure's end to the next's, s.", show_default="3, or the config's"),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="How long to go on, s.", min=0.0, show_default="until you stop it")
    ] = None,
    buffer: Annotated[
        float, typer.Option(help="How much of the flight can be gone back to, minutes.", min=0.1, max=120.0)
    ] = 10.0,
    rate: Annotated[
        float | None,
        typer.Option(help="Attitudes a second to ask for.", min=1, max=1000, show_default="what the link can carry"),
    ] = None,
    flags: FlightFlags,
    utc_now: Annotated[
        bool, typer.Option("--utc-now", help="The computer's clock is UTC where the link tells none.")
    ] = False,
    format_: Format = None,
    seed: Annotated[int, typer.Option(help="Seed of the noise.", min=0)] = 0,
    force: Annotated[bool, typer.Option("--force", help="Remove the frames that are in the directory.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
    show: Show = None,
    size: Size = "1280x800",
    screenshot: Screenshot = None,
    stats: Stats = None,
    headless: Headless = False,
) -> None:
    """Show what the camera on an aircraft sees now, from its telemetry link, in a window; or write it as frames.

    Try: glstar live /dev/ttyUSB0,57600 --record flight.tlog
    """
    if link is None:
        _list_ports()
        return
    _refuse_file(link)
    draws = export is not None or latest_frame is not None
    _refuse_senseless(
        draws=draws,
        headless=headless,
        to_do=record is not None or screenshot is not None or stats is not None,
        of_window=screenshot is not None or stats is not None or show is not None,
        timeless=stats is not None and duration is None,
    )
    width_height = size_of(size)
    settings = flags.settings(**{"exposure.duration_s": exposure, "exposure.interval_s": every})
    flight = settings.flight
    with ExitStack() as held:
        endpoint = Endpoint.parse(link)
        recorder = None if record is None else held.enter_context(Recorder(record))
        opened = held.enter_context(
            Link(
                endpoint,
                flight.options,
                sysid=flight.sysid,
                utc_now=utc_now,
                rate_hz=rate,
                keep_s=60.0 * buffer,
                recorder=recorder,
            )
        )
        typer.echo(f"listening on {endpoint.text}; Ctrl-C stops", err=True)
        began_s = time.monotonic()
        report: dict[str, object] = {}
        if headless and screenshot is None and stats is None and not draws:
            _only_record(opened, duration)
        elif not draws:
            from glstar.viewer.loop import Script, Viewer  # noqa: PLC0415 - a window, when it is needed

            overlays = overlays_of(show)
            script = Script(overlays=overlays, screenshot=screenshot, play_s=duration)
            surface = surface_of(width_height, headless=headless)
            held.callback(surface.close)
            layout = layout_of("live") if script == Script(overlays=overlays) else None
            viewer = held.enter_context(Viewer(surface, settings, layout=layout))
            viewer.follow(opened, on_event=_say)
            with suppress(KeyboardInterrupt):
                report = _seen(_show(viewer, script, stays=duration is None and not headless, stats=stats))
        else:
            # OpenCV and OpenGL, when they are needed.
            from glstar.export.liveexport import LiveExport  # noqa: PLC0415
            from glstar.render.opengl import GLRenderer  # noqa: PLC0415

            renderer = held.enter_context(GLRenderer.headless())
            camera = settings.camera()
            pixels = camera.width_px * camera.height_px
            latest = None if latest_frame is None else held.enter_context(LatestFrameWriter(latest_frame, pixels))
            job = LiveExport(
                settings,
                opened,
                directory=export,
                latest=latest,
                image_format=format_,
                seed=seed,
                command=shlex.join(["glstar", *sys.argv[1:]]),
            )
            report = _facts(job.run(renderer, duration_s=duration, force=force, tell=_say))
        took_s = time.monotonic() - began_s
        status = opened.status()
    if not status.packets:
        raise LinkTimeoutError(endpoint.text, took_s)
    facts = {
        "seconds": round(took_s, 3),
        "vehicle": status.vehicle,
        "packets": status.packets,
        "lost": status.lost,
        "utc": status.utc_source,
        "recorded_bytes": status.recorded_bytes,
        **report,
    }
    typer.echo(json.dumps(facts) if as_json else _words(facts))


def _refuse_senseless(*, draws: bool, headless: bool, to_do: bool, of_window: bool, timeless: bool) -> None:
    """Refuse flags that contradict each other."""
    if draws and (of_window or headless):
        raise typer.BadParameter("--export and --latest-frame open no window: --show, --screenshot, --stats are of it")
    if headless and not to_do:
        raise typer.BadParameter(
            "without a window there is nothing to do but --record, --export, --latest-frame or --screenshot",
            param_hint="--headless",
        )
    if timeless:
        raise typer.BadParameter("--stats tells of --duration SECONDS", param_hint="--stats")


def _show(viewer: "Viewer", script: "Script", *, stays: bool, stats: Path | None) -> dict[str, Any]:
    """Show the link in the viewer's window, and return what `Viewer.play` tells of it."""
    report = viewer.play(script) if script.screenshot is not None or script.play_s is not None else {}
    if stats is not None:
        write_stats(stats, report)
    if stays:
        viewer.run()
    return report


def _seen(report: dict[str, Any]) -> dict[str, object]:
    if not report:
        return {}
    latency_ms = report["link"]["latency_ms"]
    return {
        "drawn": report["link"]["images"],
        "directory": None,
        **{
            f"latency_{words}_s": None if latency_ms[share] is None else round(latency_ms[share] / 1e3, 4)
            for words, share in (("median", "median"), ("95", "p95"))
        },
    }


def _only_record(link: Link, duration_s: float | None) -> None:
    """Wait while the link records, and say what happens."""
    told, until_s = 0, None if duration_s is None else time.monotonic() + duration_s
    try:
        while until_s is None or time.monotonic() < until_s:
            for event in link.events(told):
                told = event.number
                _say(event.message)
            time.sleep(0.1)
    except KeyboardInterrupt:
        return


def _say(words: str) -> None:
    typer.echo(f"{time.strftime('%H:%M:%S')} {words}", err=True)


def _facts(report: "LiveReport") -> dict[str, object]:
    latency_s = {share: report.latency_quantile_s(share) for share in (0.5, 0.95)}
    return {
        "directory": None if report.directory is None else str(report.directory),
        "drawn": report.drawn,
        "skipped": dict(Counter(frame.reason for frame in report.skipped)),
        "latency_median_s": None if latency_s[0.5] is None else round(latency_s[0.5], 4),
        "latency_95_s": None if latency_s[0.95] is None else round(latency_s[0.95], 4),
    }


def _words(facts: dict[str, object]) -> str:
    lines = [
        f"{facts['packets']} packets in {facts['seconds']} s, {facts['lost']} lost; UTC: {facts['utc'] or 'unknown'}"
    ]
    if facts["recorded_bytes"]:
        lines.append(f"{facts['recorded_bytes']} bytes recorded")
    if "drawn" in facts:
        lines.append(f"{facts['drawn']} frames drawn" + (f": {facts['directory']}" if facts["directory"] else ""))
    skipped = facts.get("skipped")
    if isinstance(skipped, dict):
        lines += [f"{count} skipped, their exposures met {reason}" for reason, count in skipped.items()]
    if facts.get("latency_median_s") is not None:
        lines.append(
            f"newest attitude to frame: median {facts['latency_median_s']} s, 95 % under {facts['latency_95_s']} s"
        )
    return "\n".join(lines)


def _refuse_file(link: str) -> None:
    """Refuse the name of a flight log, which is easily given for a link."""
    if Path(link).is_file():
        raise LinkError(link, f"is a file, not a link; replay a flight log with 'glstar view {link}'")


def _list_ports() -> None:
    """Say which serial ports there are, and how to name a link."""
    ports = serial_ports()
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
        "  udpout:192.168.1.7:14550     somebody who waits to be spoken to\n"
        "  tcp:127.0.0.1:5760           a simulator\n"
        "No vehicle at hand? glstar replay-link FLIGHT udpout:127.0.0.1:14550 plays one."
    )
