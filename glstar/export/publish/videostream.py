"""Frames as H.264 video: to a viewer by RTP, as simulators send it to ground stations, or into a transport stream.

``rtp://127.0.0.1:5600`` is what QGroundControl, Gazebo's plugins and ``gst-launch-1.0 udpsrc port=5600`` agree on: RTP
(RFC 6184) with payload type 96.  Time stamps are the starts of the exposures, by the clock of the navigator,
in units of 1/90,000 s.  A keyframe with its parameters follows every second, for viewers that come late.
"""

import re
import socket
from contextlib import suppress
from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError, ExportError
from glstar.export.imagefiles.processing import shown_as_8_bits
from glstar.export.publish.stream import LOOPBACK
from glstar.sky.place.timescale import parse_utc
from glstar.system.installation import install_command

RTP = "rtp://"
RTP_PORT = 5600
_ADDRESS = re.compile(r"rtp://(?:(\d{1,5})|(\[[0-9a-fA-F:]+\]|[^:/\[\]]+)(?::(\d{1,5}))?)?/?")
_SUFFIXES = {".ts", ".m2ts"}
_PAYLOAD_TYPE = 96
# RFC 6184: the clock of H.264, Hz.
_CLOCK_HZ = 90_000
# Bytes of a packet: below what a tunnel leaves of the 1500 of Ethernet.
_PACKET_BYTES = 1200
# Time from one keyframe to the next, s.
_KEYFRAME_S = 1.0
# Faint stars survive this factor; a frame of 1014 x 760 px has some 100 kB.
_ENCODER = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "crf": "18"}


class RtpAddress(NamedTuple):
    """Where RTP packets are sent."""

    host: str
    port: int

    @classmethod
    def parse(cls, where: str) -> Self:
        """Return the address of ``rtp://HOST:PORT``; this computer and port 5600 where they are left out.

        Raises ConfigError if it is not valid.
        """
        parts = _ADDRESS.fullmatch(where)
        port = RTP_PORT if parts is None else int(parts[1] or parts[3] or RTP_PORT)
        if parts is None or not 0 < port < 65535:  # the port above is that of RTCP
            raise ConfigError(f"{where} is no address; write rtp://HOST:PORT, or rtp://PORT for this computer")
        return cls((parts[2] or LOOPBACK).strip("[]"), port)

    @property
    def sdp(self) -> str:
        """The session's description (RFC 8866), which players open: ``ffplay`` and VLC."""
        family = "IP6" if ":" in self.host else "IP4"
        lines = (
            "v=0",
            f"o=- 0 0 IN {family} {self.host}",
            "s=glstar",
            f"c=IN {family} {self.host}",
            "t=0 0",
            f"m=video {self.port} RTP/AVP {_PAYLOAD_TYPE}",
            f"a=rtpmap:{_PAYLOAD_TYPE} H264/{_CLOCK_HZ}",
            f"a=fmtp:{_PAYLOAD_TYPE} packetization-mode=1",
        )
        return "\r\n".join((*lines, ""))


class VideoStream:
    """Encodes frames as H.264; a context manager.

    `where` is ``rtp://HOST:PORT``, or a new file ``NAME.ts``: an MPEG transport stream, which can be played while it
    grows, and is complete whenever it ends.  The sensor's saturation is white, unless ``[output]`` processes the
    images; `interval_s`: time between frames, s; `summed`: the number of short exposures whose sum a frame is.  An odd
    last row or column is left out.  Raises ConfigError if the name is not valid or PyAV is not installed; ExportError
    if the file exists or cannot be written.
    """

    needs_nav = True

    def __init__(self, where: str, camera: Camera, sensor: Sensor, *, interval_s: float, summed: int = 1) -> None:
        self._av, self._where, self._sensor, self._summed = _library(), where, sensor, summed
        self._size_px = camera.width_px // 2 * 2, camera.height_px // 2 * 2
        self._interval_s = interval_s
        self._file: Any = None
        self._stream: Any = None
        self._first_s, self._last_ticks = 0.0, -1
        self.address = RtpAddress.parse(where) if where.startswith(RTP) else None
        if self.address is None:
            _create(Path(where))

    def write(self, pixels: NDArray[Any], _truth: bytes, nav: dict[str, Any]) -> None:
        """Encode a frame, and send or write it.

        `pixels` (height, width) uint8 or uint16; `nav`: the record of the navigator, for the UTC of its clock.  Raises
        ExportError if it cannot be sent or written.
        """
        shown = shown_as_8_bits(pixels, self._sensor, summed=self._summed)
        width_px, height_px = self._size_px
        cut = np.ascontiguousarray(shown[:height_px, :width_px])
        picture = self._av.VideoFrame.from_ndarray(cut if cut.ndim == 3 else cv2.cvtColor(cut, cv2.COLOR_GRAY2RGB))
        start_s = parse_utc(nav["utc"]["start"])
        try:
            if self._file is None:
                self._open(start_s, nav["utc"]["start"])
            ticks = round((start_s - self._first_s) * _CLOCK_HZ)
            if ticks <= self._last_ticks:
                # The clock was set back; the time stamps of a stream rise.
                ticks = self._last_ticks + round(self._interval_s * _CLOCK_HZ)
                self._first_s = start_s - ticks / _CLOCK_HZ
            self._last_ticks = ticks
            picture.pts, picture.time_base = ticks, Fraction(1, _CLOCK_HZ)
            self._file.mux(self._stream.encode(picture))
        except (OSError, self._av.FFmpegError) as error:
            raise ExportError(self._where, f"the video cannot be sent or written ({error.strerror})") from error

    def _open(self, start_s: float, utc: str) -> None:
        """Begin the stream at the first frame; the origin of its time stamps is the millisecond in which it began.

        FFmpeg states UTC in whole milliseconds, whatever it is given.
        """
        self._first_s = floor(start_s * 1000) / 1000
        if self.address is None:
            self._file = self._av.open(self._where, "w", format="mpegts")
            self._file.metadata.update(service_provider="glstar", service_name=f"from {utc}")
        else:
            host, port = self.address
            own = f"&localaddr={LOOPBACK}" if host == LOOPBACK else ""
            url = f"rtp://{f'[{host}]' if ':' in host else host}:{port}?pkt_size={_PACKET_BYTES}{own}"
            # By the reports of RTCP the time stamps are UTC.
            options = {"payload_type": str(_PAYLOAD_TYPE), "start_time_realtime": str(round(self._first_s * 1e6))}
            self._file = self._av.open(url, "w", format="rtp", options=options)
        rate = Fraction(1 / self._interval_s).limit_denominator(1000)
        self._stream = self._file.add_stream("libx264", rate=max(rate, Fraction(1, 1000)), options=_ENCODER)
        self._stream.width, self._stream.height = self._size_px
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        self._stream.codec_context.gop_size = max(round(_KEYFRAME_S / self._interval_s), 1)

    def close(self) -> None:
        """Complete the stream; a second call does nothing."""
        file, self._file = self._file, None
        if file is None:
            if self.address is None and self._last_ticks < 0:
                Path(self._where).unlink(missing_ok=True)  # no frame came
            return
        with suppress(OSError, self._av.FFmpegError):  # a full disk was reported with the frame
            file.mux(self._stream.encode(None))
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_video(where: str) -> None:
    """Raise ConfigError if a name is neither ``rtp://HOST:PORT`` of a known host nor ``NAME.ts``, or without PyAV."""
    if where.startswith(RTP):
        host, port = RtpAddress.parse(where)
        try:
            socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise ConfigError(f"{where}: the host {host} is not known ({error.strerror})") from None
    elif "://" in where or Path(where).suffix.lower() not in _SUFFIXES:
        other = "; glstar export --video writes .webm and .mp4" if Path(where).suffix in {".mp4", ".webm"} else ""
        raise ConfigError(f"{where} is no live video: write rtp://HOST:PORT, or a file NAME.ts{other}")
    _library()


def _create(path: Path) -> None:
    """Create a new file."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise ExportError(path, "is there already; write the video to another file") from None
    except OSError as error:
        raise ExportError(path, f"cannot be written ({error.strerror})") from error


def _library() -> Any:
    try:
        import av  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"a live video needs PyAV: {install_command('film')}") from error
    return av
