"""The controls of the play head, drawn with imgui."""

from imgui_bundle import imgui

from glstar.errors import ConfigError
from glstar.sky.place.timescale import format_utc
from glstar.viewer.flight.playhead import FASTEST, SLOWEST, Mode, PlayHead
from glstar.viewer.ui.theme import draw_choice, scaled

# Width of the time field and the text beside it, px.
_TIME_PX = 600
_SPEEDS = tuple(SLOWEST * 2**k for k in range(9) if SLOWEST * 2**k <= FASTEST)
_ENTER = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)


class PlaybackControls:
    """The controls of the play head: play, step, direction, speed, loop, mode, marker, and a field for the time.

    `error`: why the time typed last is not valid.
    """

    def __init__(self) -> None:
        self.error: str | None = None

    def draw(self, head: PlayHead) -> None:
        """Draw the controls into the current imgui window, and apply them."""
        if _button("|<", "to the start of the flight"):
            head.first()
        if _button("<<", "one exposure back"):
            head.step_exposures(-1)
        if _button("pause" if head.playing else "play", "play or pause", width_px=60):
            head.toggle()
        if _button(">>", "one exposure on"):
            head.step_exposures(1)
        if _button(">|", "to the end of the flight"):
            head.last()
        if head.grows:
            _live(head)
        if _button("reverse", "reverse the direction"):
            head.reverse()
        _speeds(head)
        imgui.same_line()
        _wrap("loop", beside_px=imgui.get_frame_height())
        _, head.loop = imgui.checkbox("loop", head.loop)
        for mode, tooltip in (
            (Mode.CAMERA, "exposures as the camera records them"),
            (Mode.SLIDING, "one that ends now"),
        ):
            imgui.same_line()
            _wrap(mode.value, beside_px=imgui.get_frame_height())
            if imgui.radio_button(mode.value, head.mode is mode):
                head.mode = mode
            imgui.set_item_tooltip(tooltip)
        imgui.same_line()
        _mark(head)
        if imgui.get_content_region_avail().x < scaled(_TIME_PX):
            imgui.new_line()
        self._draw_time(head)

    def _draw_time(self, head: PlayHead) -> None:
        imgui.set_next_item_width(scaled(110))
        # Digits that change in every frame cannot be read, and would have the panel painted in every frame.
        digits = 1 if head.playing else 3
        entered, text = imgui.input_text("s", f"{head.second:.{digits}f}", _ENTER)
        imgui.set_item_tooltip("type 12.5, 1:02.5, +5, -0.1, 11:01:40Z or 2024-03-10T11:00:00Z, then Enter")
        if entered:
            try:
                head.seek_text(text)
                self.error = None
            except ConfigError as error:
                self.error = str(error)
        imgui.same_line()
        number = head.number
        which = "" if number is None else f"   exposure {number} (0 to {head.count - 1})"
        utc = f"{format_utc(head.utc_s)[:21]}Z" if head.playing else format_utc(head.utc_s)
        imgui.text(f"of {head.length_s:.1f}   {utc}{which}")
        if self.error is not None:
            imgui.text_wrapped(self.error)


def _wrap(label: str, *, width_px: float = 0, beside_px: float = 0) -> None:
    """Continue in the next line if a control with this label or width does not fit."""
    padding_px = 2 * imgui.get_style().frame_padding.x
    needed_px = width_px or imgui.calc_text_size(label, hide_text_after_double_hash=True).x + padding_px + beside_px
    if imgui.get_content_region_avail().x < needed_px:
        imgui.new_line()


def _button(label: str, tooltip: str, *, width_px: float = 0) -> bool:
    width_px = scaled(width_px)
    _wrap(label, width_px=width_px)
    pressed = imgui.button(label, (width_px, 0))
    imgui.set_item_tooltip(tooltip)
    imgui.same_line()
    return pressed


def _mark(head: PlayHead) -> None:
    if head.marker is None:
        if _button("mark", "add a marker here", width_px=60):
            head.add_marker()
    elif _button("unmark", "remove the marker", width_px=60):
        head.remove_marker()


def _live(head: PlayHead) -> None:
    """Draw the button that returns to the present sky; it is highlighted while that is shown."""
    if head.live:
        imgui.push_style_color(int(imgui.Col_.button), imgui.get_style_color_vec4(int(imgui.Col_.button_active)))
    behind = "LIVE" if head.live else f"{head.last_s - head.utc_s:.0f} s behind: go live"
    pressed = _button(f"{behind}###live", "the present sky (F)")
    if head.live:
        imgui.pop_style_color()
    if pressed:
        head.last()


def _speeds(head: PlayHead) -> None:
    _wrap("", width_px=scaled(75))
    imgui.set_next_item_width(scaled(75))
    speeds = {_times(signed): signed for signed in (speed if head.speed > 0 else -speed for speed in _SPEEDS)}
    if name := draw_choice("##speed", _times(head.speed), dict.fromkeys(speeds, ""), _times(head.speed)):
        head.speed = speeds[name]
    imgui.set_item_tooltip("seconds of flight per second")


def _times(speed: float) -> str:
    """Return a speed as text: 1/8x, 1x, -32x."""
    return f"{speed:g}x" if abs(speed) >= 1 else f"{'-' if speed < 0 else ''}1/{abs(1 / speed):g}x"
