"""The dialog that asks which range of the flight a video shows, and how fast."""

from pathlib import Path
from typing import Final

from imgui_bundle import ImVec2, imgui

from glstar.errors import ConfigError
from glstar.viewer.saving import SCREEN_FRAMES_PER_S, file_stem, unused_path
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import centre_next_window, error
from glstar.viewer.video import RangeVideo, VideoRange

__all__ = ["VideoDialog"]

_AUTO: Final = int(imgui.WindowFlags_.always_auto_resize)
# Width of the widest field, screen px.
_WIDTH: Final = 440.0


class VideoDialog:
    """Asks for the range, the speed and the frame rate of a video."""

    _TITLE: Final = "Video of a range"

    def __init__(self) -> None:
        self._opening = False
        self._start_s = self._stop_s = 0.0
        self._speed = 1.0
        self._frames_per_s = SCREEN_FRAMES_PER_S
        self._path = ""

    def ask(self, session: Session) -> None:
        """Open the dialog for the part between the in and out points.

        Parameters
        ----------
        session : Session
        """
        if session.head is None:
            return
        if session.video is not None:
            session.notify("a video is being recorded; end it first (Ctrl+R)", is_error=True)
            return
        self._path = str(unused_path(session.output / f"{file_stem(session)}-range.mp4"))
        self._start_s, self._stop_s = (end_s - session.head.origin_s for end_s in session.head.part)
        self._opening = True

    def draw(self, session: Session) -> None:
        """Draw the dialog if it is open.

        Parameters
        ----------
        session : Session
        """
        if self._opening:
            imgui.open_popup(self._TITLE)
            self._opening = False
        centre_next_window()
        if imgui.begin_popup_modal(self._TITLE, None, _AUTO)[0]:
            self._draw_fields(session)
            imgui.end_popup()

    def _draw_fields(self, session: Session) -> None:
        assert session.head is not None
        imgui.push_item_width(_WIDTH * 0.45)
        _, self._start_s = imgui.input_double("from, s", self._start_s, 1.0, 10.0, "%.3f")
        _, self._stop_s = imgui.input_double("to, s", self._stop_s, 1.0, 10.0, "%.3f")
        _, self._speed = imgui.input_double("times real time", self._speed, 0.0, 0.0, "%g")
        _, self._frames_per_s = imgui.input_double("frames/s", self._frames_per_s, 0.0, 0.0, "%g")
        imgui.pop_item_width()
        imgui.set_next_item_width(_WIDTH)
        _, self._path = imgui.input_text("##path", self._path)
        part: VideoRange | None = None
        try:
            part = self._part(session)
            length_s = part.count / part.frames_per_s
            imgui.text_disabled(f"{part.count} frames, {length_s:.1f} s; the picture as it is shown, with its overlays")
        except ConfigError as refusal:
            imgui.text_colored(error(), str(refusal))
        imgui.begin_disabled(part is None or not self._path.strip())
        entered = imgui.is_key_pressed(imgui.Key.enter) and not imgui.is_any_item_active()
        if (imgui.button("Record", ImVec2(90, 0)) or (entered and self._path.strip())) and part is not None:
            imgui.close_current_popup()
            path = Path(self._path.strip()).expanduser()
            session.video = RangeVideo(path if path.suffix else path.with_suffix(".mp4"), part)
        imgui.end_disabled()
        imgui.same_line()
        if imgui.button("Cancel", ImVec2(90, 0)) or imgui.is_key_pressed(imgui.Key.escape):
            imgui.close_current_popup()

    def _part(self, session: Session) -> VideoRange:
        head = session.head
        assert head is not None
        start_s, stop_s = (
            min(max(head.origin_s + end_s, head.first_s), head.last_s) for end_s in (self._start_s, self._stop_s)
        )
        return VideoRange(start_s, stop_s, self._speed, self._frames_per_s)
