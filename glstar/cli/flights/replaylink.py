"""``glstar replay-link``: send a flight over a telemetry link, as an autopilot would."""

import json
from pathlib import Path
from typing import Annotated

import typer

from glstar.cli.flightoptions import CAMERA_FLAGS, FlightFlags, with_flight_flags
from glstar.cli.reporting import echo_note, with_verbosity
from glstar.link import Endpoint, Vehicle, carried_rate_hz, open_transport


# The camera's clock does not apply to a vehicle.
@with_verbosity
@with_flight_flags(but={"time_offset", *CAMERA_FLAGS})
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

    Try: glstar replay-link flight.BIN udpout:127.0.0.1:14550
    """
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
