"""``glstar answer``: a navigator's answers, sent to ``glstar live``."""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from glstar.errors import AnswersError
from glstar.export.publish.stream import send_answers
from glstar.score.answers import parse_answer

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
    """Send an answer of a navigator to glstar live, or those of the standard input, one JSON line each.

    Frames of --export and --latest-frame are named by --frame; a live window takes --utc.

    Try: glstar answer zmq://127.0.0.1:5557 --frame 12 --lat -34.93 --lon 138.6 --sigma-km 2
    """
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
