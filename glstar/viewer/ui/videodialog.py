"""The dialog that asks which range of the flight a video shows, and how fast."""

from pathlib import Path
from typing import ClassVar

from imgui_bundle import imgui

from glstar.errors import ConfigError
from glstar.viewer.saving import SCREEN_FRAMES_PER_S, file_stem, unused_path
from glstar.viewer.session import Session
from glstar.viewer.ui.rangedialog import RangeDialog
from glstar.viewer.ui.theme import error
from glstar.viewer.video import RangeVideo, VideoRange

__all__ = ["VideoDialog"]


class VideoDialog(RangeDialog):
    """Asks for the range, the speed and the frame rate of a video."""

    title: ClassVar = "Video of a range"
    action: ClassVar = "Record"

    def __init__(self) -> None:
        super().__init__()
        self._speed = 1.0
        self._frames_per_s = SCREEN_FRAMES_PER_S

    def prepare(self, session: Session) -> bool:
        """Name a new file; a video that is being recorded has to end first.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """
        if session.video is not None:
            session.notify("a video is being recorded; end it first (Ctrl+R)", is_error=True)
            return False
        self.path = str(unused_path(session.output / f"{file_stem(session)}-range.mp4"))
        return True

    def draw_options(self) -> None:
        """Draw the speed and the frame rate."""
        _, self._speed = imgui.input_double("times real time", self._speed, 0.0, 0.0, "%g")
        _, self._frames_per_s = imgui.input_double("frames/s", self._frames_per_s, 0.0, 0.0, "%g")

    def draw_summary(self, session: Session) -> bool:
        """Draw the length of the video, or why it cannot be made.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """
        try:
            part = self._part(session)
            length_s = part.count / part.frames_per_s
        except ConfigError as refusal:
            imgui.text_colored(error(), str(refusal))
            return False
        imgui.text_disabled(f"{part.count} frames, {length_s:.1f} s; the picture as it is shown, with its overlays")
        return True

    def accept(self, session: Session) -> None:
        """Record the video.

        Parameters
        ----------
        session : Session
        """
        path = Path(self.path.strip()).expanduser()
        session.video = RangeVideo(path if path.suffix else path.with_suffix(".mp4"), self._part(session))

    def _part(self, session: Session) -> VideoRange:
        head = session.head
        assert head is not None
        start_s, stop_s = (
            min(max(head.origin_s + end_s, head.first_s), head.last_s) for end_s in (self.start_s, self.stop_s)
        )
        return VideoRange(start_s, stop_s, self._speed, self._frames_per_s)
