"""``glstar view``: the flight-replay viewer."""

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from glstar.cli.flightoptions import Flight, FlightFlags, log_of, with_flight_flags

if TYPE_CHECKING:
    from glstar.viewer.overlays import Overlay
    from glstar.viewer.surface import Surface

__all__ = ["view"]


def _size(text: str) -> tuple[int, int]:
    words = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    if not words:
        raise typer.BadParameter(f"{text!r} is no size; write 1280x800", param_hint="--size")
    return int(words[1]), int(words[2])


@with_flight_flags()
def view(
    flight: Flight = None,
    *,
    flags: FlightFlags,
    at: Annotated[
        float | None, typer.Option(help="Where to begin, s from the flight's first attitude.", show_default="0")
    ] = None,
    sliding: Annotated[
        bool, typer.Option("--sliding", help="The exposure ends at the play head, continuously.")
    ] = False,
    show: Annotated[
        str | None,
        typer.Option(
            help="What to draw over the image, with commas: star names, constellations, horizon, ... or nothing.",
            show_default="star names",
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="A folder of real images to compare with.", show_default=False)
    ] = None,
    size: Annotated[str, typer.Option(help="Width and height of the window, px.")] = "1280x800",
    screenshot: Annotated[
        Path | None, typer.Option(help="Write a picture of the window (PNG).", show_default=False)
    ] = None,
    play: Annotated[float | None, typer.Option(help="Play for so many seconds.", min=0.1, show_default=False)] = None,
    stats: Annotated[
        Path | None, typer.Option(help="Write how long the frames took while playing, as JSON.", show_default=False)
    ] = None,
    leave: Annotated[bool, typer.Option("--exit", help="Leave when that is done.")] = False,
    headless: Annotated[
        bool, typer.Option("--headless", help="Open no window: for --screenshot and --stats without a display.")
    ] = False,
) -> None:
    """Replay a flight in a window, as the camera would have recorded it.

    F1 lists the keys. A log, settings (.toml) or a folder of real images can be dropped onto the window.

    Try: glstar view flight.BIN
    """
    settings = flags.settings()
    width_height = _size(size)
    scripted = screenshot is not None or play is not None
    if headless and not scripted:
        raise typer.BadParameter(
            "without a window there is nothing to do but --screenshot or --play", param_hint="--headless"
        )
    if stats is not None and play is None:
        raise typer.BadParameter("--stats tells of --play SECONDS", param_hint="--stats")

    from glstar.viewer.loop import Script, Viewer  # noqa: PLC0415 - a window, when it is needed
    from glstar.viewer.playhead import Mode  # noqa: PLC0415

    overlays = None if show is None else _overlays(show)
    surface = _surface(width_height, headless=headless)
    try:
        layout = None if headless or scripted else _layout()
        with Viewer(surface, settings, layout=layout) as viewer:
            viewer.open(log_of(flight))
            if images is not None:
                viewer.session.comparison.open(images)
            script = Script(at, Mode.SLIDING if sliding else None, overlays, screenshot, play)
            if scripted or leave or script != Script():
                report = viewer.play(script)
                if stats is not None:
                    stats.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
            if not (leave or headless):
                viewer.run()
    finally:
        surface.close()


def _overlays(text: str) -> "frozenset[Overlay]":
    from glstar.viewer.overlays import Overlay  # noqa: PLC0415

    names = {name.strip() for name in text.split(",")} - {"", "nothing"}
    unknown = names - set(Overlay)
    if unknown:
        raise typer.BadParameter(f"{min(unknown)!r} is none of {', '.join(Overlay)}", param_hint="--show")
    return frozenset(Overlay(name) for name in names)


def _surface(size: tuple[int, int], *, headless: bool) -> "Surface":
    if headless:
        from glstar.viewer.headless import Headless  # noqa: PLC0415

        return Headless(size)
    from glstar.viewer.window import Window  # noqa: PLC0415

    return Window(size)


def _layout() -> Path:
    """Return where the places of the panels are remembered."""
    from platformdirs import user_config_path  # noqa: PLC0415

    return user_config_path("glstar", ensure_exists=True) / "viewer.ini"
