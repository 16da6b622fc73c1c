"""What meets ``glstar live`` on a link: ``live replay`` plays a vehicle, ``live answer`` sends positions."""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from glstar.cli.flightoptions import CAMERA_FLAGS, FlightFlags, with_flight_flags
from glstar.cli.reporting import echo_note
from glstar.errors import AnswersError

# Probability within one standard deviation of each of two components.
_ONE_SIGMA = float(-np.expm1(-0.5))


def answer(
    where: Annotated[str, typer.Argument(help="The address of glstar live --answers: zmq://HOST:PORT.")],
    *,
    frame: Annotated[
        int | None, typer.Option(help="Number of the frame.", min=0, show_default="JSON lines of the standard input")
    ] = None,
    utc: Annotated[
        str | None,
        typer.Option(help="UTC of the answer by the camera's clock, for a live window.", show_default=False),
    ] = None,
    lat: Annotated[float | None, typer.Option(help="Latitude, deg.", min=-90, max=90)] = None,
    lon: Annotated[float | None, typer.Option(help="Longitude, deg.", min=-180, max=360)] = None,
    sigma_km: Annotated[
        float | None, typer.Option(help="Standard deviation of each horizontal component, km.", min=1e-6)
    ] = None,
    instant: Annotated[
        Literal["start", "middle", "end"], typer.Option(help="Which instant of the exposure it is for.")
    ] = "middle",
    timeout: Annotated[float, typer.Option(help="How long to wait for glstar live, s.", min=0.1, max=600)] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Send a navigator's answer to glstar live, or the lines of the standard input, one JSON answer each.

    Frames of --export and --latest-frame are named by --frame; a live window takes --utc.

    Try: glstar live answer zmq://127.0.0.1:5557 --frame 12 --lat -34.93 --lon 138.6 --sigma-km 2
    """
    from glstar.export.publish.stream import send_answers  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.score.answers import parse_answer  # noqa: PLC0415 - the score, only when needed

    if frame is None and utc is None:
        if any(value is not None for value in (lat, lon, sigma_km)):
            raise typer.BadParameter(
                "a position needs the number of its frame, or its UTC", param_hint="--frame, --utc"
            )
        sent = refused = 0
        for number, line in enumerate(sys.stdin, 1):
            if not line.strip():
                continue
            try:
                parse_answer(Path("-"), number, line)
            except AnswersError as error:
                typer.echo(f"not sent: {error}", err=True)
                refused += 1
            else:
                send_answers(where, [line.strip()], timeout)
                sent += 1
    else:
        if lat is None or lon is None:
            raise typer.BadParameter("an answer has a latitude and a longitude", param_hint="--lat, --lon")
        line = _line({"frame": frame} if utc is None else {"utc": utc}, lat, lon, sigma_km, instant)
        parse_answer(Path("-"), 1, line)
        send_answers(where, [line], timeout)
        sent, refused = 1, 0
    text = f"{sent} answers sent to {where}" + (f", {refused} refused" if refused else "")
    typer.echo(json.dumps({"sent": sent, "refused": refused}) if as_json else text)
    if refused:
        raise typer.Exit(1)


def _line(of: dict[str, object], lat: float, lon: float, sigma_km: float | None, instant: str) -> str:
    """Return an answer as a JSON line; ``of`` has its frame or its time."""
    values: dict[str, object] = {**of, "latitude_deg": lat, "longitude_deg": lon, "instant": instant}
    if sigma_km is not None:
        values |= {"ellipse_major_km": sigma_km, "ellipse_minor_km": sigma_km, "ellipse_azimuth_deg": 0.0}
        values["ellipse_confidence"] = _ONE_SIGMA
    return json.dumps(values)


@with_flight_flags(but={"time_offset", "mount", *CAMERA_FLAGS})
def replay_link(
    flight: Annotated[Path, typer.Argument(help="A flight log, of any kind that 'glstar info' reads.")],
    link: Annotated[
        str, typer.Argument(help="The link: udpout:127.0.0.1:14550, tcpin:127.0.0.1:5760, /dev/ttyUSB0,57600.")
    ],
    *,
    flags: FlightFlags,
    start: Annotated[float, typer.Option(help="Start, s from the first attitude of the flight.")] = 0.0,
    speed: Annotated[float, typer.Option(help="Seconds of flight per second.")] = 1.0,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Rate of the attitude until another one is requested, Hz.", show_default="what the link can carry"
        ),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, as after a reboot.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Send a flight as MAVLink 2 in real time, a vehicle for glstar live, MAVProxy or QGroundControl.

    Try: glstar live replay flight.BIN udpout:127.0.0.1:14550
    """
    from glstar.link import Endpoint, Vehicle, carried_rate_hz, open_transport  # noqa: PLC0415 - pymavlink

    endpoint = Endpoint.parse(link)
    played = flags.settings().open_flight(flight)
    rate_hz = min(carried_rate_hz(endpoint), played.attitude.rate_hz) if rate is None else rate
    with open_transport(endpoint) as transport:
        vehicle = Vehicle(played, transport, start_s=start, speed=speed, rate_hz=rate_hz, loop=loop)
        echo_note(
            f"{played.name}, {played.attitude_source}, {played.attitude.last_s - played.attitude.first_s:.1f} s,"
            f" to {endpoint.text} at {rate_hz:g} Hz; Ctrl-C stops"
        )
        done = vehicle.run()
    if as_json:
        facts = {"duration_s": round(done.duration_s, 3), "packets": done.packets, "dropped": done.dropped}
        typer.echo(json.dumps(facts))
        return
    dropped = f", {done.dropped} more than the link could carry" if done.dropped else ""
    typer.echo(f"{done.duration_s:.1f} s played, {done.packets} packets{dropped}")
