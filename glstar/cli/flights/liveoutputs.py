"""The options of ``glstar live`` for programs that get the frames while they are drawn."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from glstar.cli.flightoptions import with_fields_as_options
from glstar.cli.images.exportoptions import FramePublishing, LatestFrame, WithTruth
from glstar.cli.reporting import echo_note
from glstar.config import Config
from glstar.link.camera import VideoFacts
from glstar.system.files import write_atomically

if TYPE_CHECKING:
    from glstar.camera.sensor.sensor import Sensor
    from glstar.export.publish.outputs import FrameOutput

Video = Annotated[
    str | None,
    typer.Option(
        help="Send the frames as H.264 video: to rtp://HOST:PORT, as ground stations receive it on port 5600, or into"
        " a new MPEG transport stream, NAME.ts.",
        show_default=False,
    ),
]
Sdp = Annotated[
    Path | None,
    typer.Option(help="Write the description of --video rtp://..., which ffplay and VLC open.", show_default=False),
]

Foxglove = Annotated[
    str | None,
    typer.Option(
        help="Show the frames in the Foxglove app, with their truth drawn over them: a WebSocket server on this port,"
        " for this computer, or on HOST:PORT for others. Without a port on 8765, which Foxglove expects.",
        show_default=False,
    ),
]


class OpenOutputs(NamedTuple):
    """Outputs that are open."""

    all: "FrameOutput | None"
    viewers: "FrameOutput | None"  # Those that show frames to people


@dataclass(frozen=True, slots=True)
class LiveOutputs:
    """Where frames go besides the files of ``--export``."""

    latest_frame: LatestFrame = None
    with_truth: WithTruth = False
    video: Video = None
    sdp: Sdp = None
    foxglove: Foxglove = None

    def __post_init__(self) -> None:
        FramePublishing(self.latest_frame, self.with_truth)
        if self.sdp is not None and not (self.video or "").startswith("rtp://"):
            raise typer.BadParameter("belongs to --video rtp://HOST:PORT", param_hint="--sdp")

    @property
    def has_any(self) -> bool:
        """Whether frames are to be drawn for any of them."""
        return self.latest_frame is not None or self.has_viewers

    @property
    def has_viewers(self) -> bool:
        """Whether people see the frames as they are drawn."""
        return self.video is not None or self.foxglove is not None

    def check(self) -> None:
        """Raise ConfigError if a name is not valid or a library is missing, before the link is opened."""
        if self.video is not None:
            from glstar.export.publish.videostream import check_video  # noqa: PLC0415 - OpenCV

            check_video(self.video)
        if self.foxglove is not None:
            from glstar.export.publish.foxgloveserver import check_foxglove  # noqa: PLC0415 - OpenCV

            check_foxglove(self.foxglove)

    def video_facts(self, settings: Config) -> VideoFacts | None:
        """Return what a MAVLink camera states about the video; None without one that a ground station can receive."""
        if self.video is None or not self.video.startswith("rtp://"):
            return None
        from glstar.export.publish.videostream import RtpAddress  # noqa: PLC0415 - OpenCV

        return VideoFacts(RtpAddress.parse(self.video).port, 1 / settings.exposure.interval_s)

    @contextmanager
    def opened(self, settings: Config, sensor: "Sensor") -> "Iterator[OpenOutputs]":
        """Open the outputs for frames of a sensor."""
        from glstar.export.publish.outputs import FrameOutputs  # noqa: PLC0415 - OpenCV

        with ExitStack() as stack:
            viewers = [stack.enter_context(closing(output)) for output in self._viewers(settings, sensor)]
            outputs = list(viewers)
            publishing = FramePublishing(self.latest_frame, self.with_truth)
            if self.latest_frame is not None:
                outputs.append(stack.enter_context(closing(publishing.opened(settings, sensor))))
            yield OpenOutputs(FrameOutputs(outputs) if outputs else None, FrameOutputs(viewers) if viewers else None)

    def _viewers(self, settings: Config, sensor: "Sensor") -> "Iterator[FrameOutput]":
        exposure = settings.exposure
        if self.foxglove is not None:
            from glstar.export.publish.foxgloveserver import FoxgloveServer  # noqa: PLC0415 - OpenCV

            server = FoxgloveServer(self.foxglove, sensor, summed=exposure.signal_factor)
            host, port = server.address
            echo_note(f"Foxglove: open the connection ws://{host}:{port}")
            yield server
        if self.video is not None:
            from glstar.export.publish.videostream import VideoStream  # noqa: PLC0415 - OpenCV

            stream = VideoStream(
                self.video,
                settings.camera(),
                sensor,
                interval_s=exposure.interval_s,
                summed=exposure.signal_factor,
            )
            if stream.address is not None:
                host, port = stream.address
                if self.sdp is not None:
                    write_atomically(self.sdp, stream.address.sdp.encode())
                described = "" if self.sdp is None else f"; described by {self.sdp}"
                echo_note(f"video: H.264 by RTP to {host}, UDP port {port}, payload type 96{described}")
            yield stream


def with_live_outputs(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter ``outputs`` of a command by one option for each field of `LiveOutputs`."""
    return with_fields_as_options(command, "outputs", LiveOutputs)
