"""A MAVLink camera component beside the vehicle, which ground stations and autopilots command to take pictures.

It is the camera of the MAVLink camera protocol, version 2 (https://mavlink.io/en/services/camera.html), with the system
of the vehicle.  Commands arrive in the thread of the link, which answers at once; what is to be exposed is taken by
another thread, which draws it and says when it is done.
"""

import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import inf, isfinite, nan
from threading import Lock
from typing import Any, NamedTuple, Self

from glstar import __version__
from glstar.errors import ConfigError
from glstar.link.camera.parameters import CameraParameter, CameraParameters, Changed
from glstar.link.packets import Packer, Packet, dialect
from glstar.link.receiver import Receiver
from glstar.telemetry.mavlink.packets import Sender

# MAV_COMP_ID_CAMERA, the first of six.
CAMERA_ID = 100
_HEARTBEAT_S = 1.0
# A command that is repeated with a higher confirmation within this time is the same one, s.
_REPEATED_S = 5.0
# PX4 sends a trigger as IMAGE_START_CAPTURE and, at once, as DO_DIGICAM_CONTROL for older cameras: within this time, s.
_SAME_TRIGGER_S = 0.1
# Pictures that wait to be drawn, and those whose CAMERA_IMAGE_CAPTURED may be asked for again.
_MOST_WAITING, _MOST_TAKEN = 10_000, 100_000
# Longest URL of CAMERA_IMAGE_CAPTURED, bytes.
_URL_BYTES = 204
_MAVLINK_VERSION = 3
# Number of the video stream, from 1.
_STREAM_ID = 1


class VideoFacts(NamedTuple):
    """What a camera states about its video: H.264 by RTP."""

    port: int  # UDP port at which ground stations receive it
    frames_per_s: float


class CameraFacts(NamedTuple):
    """What a camera states about itself."""

    model: str
    width_px: int
    height_px: int
    exposure_s: float  # From the first opening to the last closing
    interval_s: float  # Between two pictures if a command gives none
    storage_mib: Callable[[], tuple[float, float]]  # Total and available
    horizontal_field_deg: float = 0.0
    video: VideoFacts | None = None  # None if it sends none
    on_gimbal: bool = False  # Whether it is on the gimbal of the link
    parameters: tuple[CameraParameter, ...] = ()  # What ground stations can change
    # Returns the span and the interval of the exposures with other values; raises ConfigError if they cannot be.
    changed: Changed | None = None
    definition: tuple[int, str] = (0, "")  # Version and URI of the file that describes the parameters


@dataclass(frozen=True, slots=True)
class Capture:
    """A picture that was commanded."""

    index: int  # Number of the picture, from 0
    start_utc_s: float  # When the exposure begins, UTC seconds since 1970
    command: str  # Such as IMAGE_START_CAPTURE
    sender: Sender  # System and component that sent it
    sequence: int  # Number that the sender gave the picture, 0 if none
    settings: Mapping[str, float] = field(default_factory=dict)  # Changeable settings, by the key of the config

    @property
    def about(self) -> dict[str, Any]:
        """Its keys in the truth."""
        system, component = self.sender
        command = {"name": self.command, "system": system, "component": component, "sequence": self.sequence}
        return {"image_index": self.index, "command": command}


class CapturedImage(NamedTuple):
    """A picture that was taken, or could not be: without a URL."""

    capture: Capture
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    height_m: float = 0.0  # Above sea level
    # Rotation from forward (the boresight), right, down of the camera to north, east, down; (w, x, y, z).
    q_ned_camera: tuple[float, float, float, float] = (nan, nan, nan, nan)
    url: str = ""


class _Now(NamedTuple):
    """When a command arrived, and who sent it."""

    host_s: float  # By `time.monotonic`
    utc_s: float | None  # UTC seconds since 1970; None while it is not known
    boot_ms: int  # Time since the vehicle booted
    above_home_m: float  # Height of the vehicle
    sender: Sender
    boot: int  # Number of the vehicle's boot
    gimbal: int = 0  # Component of the gimbal, or its number; 0 if none

    @classmethod
    def of(cls, receiver: Receiver, host_s: float, sender: Sender) -> Self:
        """Return the time of an arrival by `time.monotonic`, s, on the vehicle's clocks."""
        utc_s, boot_s = receiver.clock.now(host_s)
        boot_ms = round(boot_s * 1e3) % 2**32
        boot = receiver.clock.boot
        return cls(host_s, utc_s, boot_ms, receiver.above_home_m, sender, boot, receiver.gimbal.device)


class _Series(NamedTuple):
    """Pictures that are taken at even intervals."""

    every_s: float
    left: int | None  # Pictures still to be taken; None without end
    next_utc_s: float
    command: str
    sender: Sender


class CameraComponent:
    """The camera of a vehicle.

    `facts`: what it states; `component`: its MAVLink component, 100 to 105; `delay_s`: time from a command to the
    opening of the shutter.  The thread of the link calls `receive` and `due`; another one `next` and `captured`.
    """

    def __init__(self, facts: CameraFacts, *, component: int = CAMERA_ID, delay_s: float = 0.0) -> None:
        self._facts = facts
        self._component = component
        self._delay_s = delay_s
        self._span_s, self._interval_s = facts.exposure_s, facts.interval_s
        self._parameters = CameraParameters(facts.parameters)
        m = self._mavlink = dialect()
        self._decode: Callable[[bytearray], Any] = m.MAVLink(None).decode
        self._packed: tuple[int, Packer] | None = None
        self._lock = Lock()
        self._waiting: deque[Capture] = deque()
        self._done: deque[CapturedImage] = deque()
        self._taken: dict[int, CapturedImage] = {}
        self._series: _Series | None = None
        self._count = 0
        # When the exposure of the latest picture ends, UTC s.
        self._busy_until_utc_s = -inf
        # Latest command of each sender for a single picture: what identifies it, and its arrival, `time.monotonic`, s.
        self._latest: dict[Sender, tuple[tuple[Any, ...], float]] = {}
        self._replies: list[Any] = []
        self._heartbeat_s = -inf
        # What the user should know; taken from the left by the link.
        self.messages: deque[str] = deque()
        self._of_streams = {m.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, m.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS}
        self._numbers = {m.MAVLINK_MSG_ID_COMMAND_LONG, m.MAVLINK_MSG_ID_COMMAND_INT, *self._parameters.numbers}
        self._makers: dict[int, Callable[[_Now], Any]] = {
            m.MAVLINK_MSG_ID_CAMERA_INFORMATION: self._information,
            m.MAVLINK_MSG_ID_CAMERA_SETTINGS: self._settings,
            m.MAVLINK_MSG_ID_STORAGE_INFORMATION: self._storage,
            m.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: self._status,
        }
        if facts.video is not None:
            self._makers[m.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION] = self._video_information
            self._makers[m.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS] = self._video_status
        self._commands: dict[int, Callable[[Any, _Now], int]] = {
            m.MAV_CMD_REQUEST_MESSAGE: lambda command, now: self._send(command.param1, command.param2, now),
            m.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE: self._resend,
            m.MAV_CMD_REQUEST_CAMERA_INFORMATION: partial(self._send_on_request, m.MAVLINK_MSG_ID_CAMERA_INFORMATION),
            m.MAV_CMD_REQUEST_CAMERA_SETTINGS: partial(self._send_on_request, m.MAVLINK_MSG_ID_CAMERA_SETTINGS),
            m.MAV_CMD_REQUEST_STORAGE_INFORMATION: lambda command, now: self._send(
                m.MAVLINK_MSG_ID_STORAGE_INFORMATION, 0.0, now if command.param2 else None
            ),
            m.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: partial(
                self._send_on_request, m.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS
            ),
            m.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: partial(
                self._send_of_stream, m.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
            ),
            m.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: partial(self._send_of_stream, m.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS),
            m.MAV_CMD_IMAGE_START_CAPTURE: self._start,
            m.MAV_CMD_IMAGE_STOP_CAPTURE: lambda _, __: self._stop(),
            m.MAV_CMD_DO_DIGICAM_CONTROL: self._digicam,
            m.MAV_CMD_DO_TRIGGER_CONTROL: self._trigger_control,
            m.MAV_CMD_SET_CAMERA_MODE: self._set_mode,
        }

    # --- for the thread of the link -----------------------------------------------------------------------------------

    def receive(self, packet: Packet, receiver: Receiver, now_s: float) -> None:
        """Process a packet that arrived at a time by `time.monotonic`, s; other than commands to it are ignored."""
        if packet.number not in self._numbers or receiver.chosen is None:
            return
        try:
            command = self._decode(bytearray(packet.content))
        except self._mavlink.MAVError:
            return
        is_mine = command.target_component == self._component
        if command.target_system not in {0, receiver.chosen[0]} or not (is_mine or command.target_component == 0):
            return
        if packet.number in self._parameters.numbers:
            self._replies += self._parameters.replies(command, self._change)
            return
        m, run = self._mavlink, self._commands.get(command.command)
        first = len(self._replies)
        result = m.MAV_RESULT_UNSUPPORTED if run is None else run(command, _Now.of(receiver, now_s, packet.sender))
        # Of commands to all components those that others know are not answered.
        if is_mine or result != m.MAV_RESULT_UNSUPPORTED:
            ack = m.MAVLink_command_ack_message(command.command, result, 0, 0, *packet.sender)
            self._replies.insert(first, ack)

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now, by `time.monotonic`, s."""
        if receiver.chosen is None:
            return []
        now = _Now.of(receiver, now_s, receiver.chosen)
        self._continue_series(now)
        while self._done:
            image = self._done.popleft()
            self._taken[image.capture.index] = image
            if len(self._taken) > _MOST_TAKEN:
                del self._taken[next(iter(self._taken))]
            self._replies.append(self._image(image, now))
        if now_s - self._heartbeat_s >= _HEARTBEAT_S:
            self._heartbeat_s = now_s
            self._replies.append(self._heartbeat())
        system = receiver.chosen[0]
        if self._packed is None or self._packed[0] != system:
            self._packed = system, Packer(system, self._component)
        packets = [self._packed[1](message) for message in self._replies]
        self._replies.clear()
        return packets

    # --- for the thread that draws ------------------------------------------------------------------------------------

    def next(self) -> Capture | None:
        """Return the oldest picture that is not drawn yet; None if there is none."""
        with self._lock:
            return self._waiting[0] if self._waiting else None

    @property
    def settings(self) -> Mapping[str, float]:
        """The present settings that can be changed, by the key of the config."""
        return self._parameters.values

    def captured(self, image: CapturedImage) -> None:
        """Report the picture of `next`, drawn or not."""
        with self._lock:
            self._waiting.popleft()
        self._done.append(image)

    def _change(self, settings: Mapping[str, float]) -> bool:
        """Take other settings for the next picture; return whether they can be."""
        assert self._facts.changed is not None
        try:
            self._span_s, self._interval_s = self._facts.changed(settings)
        except ConfigError as error:
            self.messages.append(f"settings of the camera are kept: {error}")
            return False
        return True

    # --- commands -----------------------------------------------------------------------------------------------------

    def _start(self, command: Any, now: _Now) -> int:
        """Take one picture, or several; parameters: interval, s, number (0 is endless), sequence number of one."""
        m = self._mavlink
        interval_s, number, sequence = command.param2, command.param3, command.param4
        if not (isfinite(number) and 0 <= number <= _MOST_TAKEN):
            return int(m.MAV_RESULT_DENIED)
        if number == 1:
            return self._take_one("IMAGE_START_CAPTURE", command, now, int(sequence) if sequence > 0 else 0)
        if not (isfinite(interval_s) and interval_s >= 0):
            return int(m.MAV_RESULT_DENIED)
        return self._start_series("IMAGE_START_CAPTURE", interval_s, int(number) or None, now)

    def _digicam(self, command: Any, now: _Now) -> int:
        """Take a picture if parameter 5 is 1; zoom, focus and session are not there."""
        if _fifth(command) != 1:
            return int(self._mavlink.MAV_RESULT_ACCEPTED)
        return self._take_one("DO_DIGICAM_CONTROL", command, now, 0)

    def _trigger_control(self, command: Any, now: _Now) -> int:
        """Begin (parameter 1 is 1) or end (0) a series at the interval of the exposures; -1 changes nothing."""
        if command.param1 == 1:
            return self._start_series("DO_TRIGGER_CONTROL", self._interval_s, None, now)
        return self._stop() if command.param1 == 0 else int(self._mavlink.MAV_RESULT_ACCEPTED)

    def _set_mode(self, command: Any, _: _Now) -> int:
        m = self._mavlink
        return int(m.MAV_RESULT_ACCEPTED if command.param2 == m.CAMERA_MODE_IMAGE else m.MAV_RESULT_DENIED)

    def _stop(self) -> int:
        self._series = None
        return int(self._mavlink.MAV_RESULT_ACCEPTED)

    def _take_one(self, name: str, command: Any, now: _Now, sequence: int) -> int:
        m = self._mavlink
        before, before_s = self._latest.get(now.sender, ((), -inf))
        # A sequence number, or a count of confirmations, marks the repetition of a command.
        is_repeated = getattr(command, "confirmation", 0) > 0 and now.host_s - before_s < _REPEATED_S
        # An autopilot numbers its commands from 1 after every boot.
        this = (name, sequence, now.boot)
        is_older_form = name == "DO_DIGICAM_CONTROL" and before[:1] == ("IMAGE_START_CAPTURE",)
        if (this == before and (sequence or is_repeated)) or (
            is_older_form and now.host_s - before_s < _SAME_TRIGGER_S
        ):
            return int(m.MAV_RESULT_ACCEPTED)
        if now.utc_s is None:
            self.messages.append(f"{name}: no picture, because UTC is not known yet")
            return int(m.MAV_RESULT_TEMPORARILY_REJECTED)
        start_utc_s = now.utc_s + self._delay_s
        if start_utc_s < self._busy_until_utc_s or self._series is not None:
            self.messages.append(f"{name}: no picture, because the camera exposes another one")
            return int(m.MAV_RESULT_TEMPORARILY_REJECTED)
        if not self._take(start_utc_s, name, now.sender, sequence):
            return int(m.MAV_RESULT_TEMPORARILY_REJECTED)
        self._latest[now.sender] = this, now.host_s
        return int(m.MAV_RESULT_ACCEPTED)

    def _start_series(self, name: str, interval_s: float, number: int | None, now: _Now) -> int:
        m = self._mavlink
        if now.utc_s is None:
            self.messages.append(f"{name}: no pictures, because UTC is not known yet")
            return int(m.MAV_RESULT_TEMPORARILY_REJECTED)
        shortest_s = self._span_s
        if interval_s < shortest_s:
            self.messages.append(f"{name}: every {shortest_s:g} s: {interval_s:g} s are shorter than an exposure")
        start_utc_s = max(now.utc_s + self._delay_s, self._busy_until_utc_s)
        self._series = _Series(max(interval_s, shortest_s), number, start_utc_s, name, now.sender)
        return int(m.MAV_RESULT_ACCEPTED)

    def _continue_series(self, now: _Now) -> None:
        """Take the pictures of a series that are due, each at its own time."""
        while (series := self._series) is not None and now.utc_s is not None and series.next_utc_s <= now.utc_s:
            self._take(series.next_utc_s, series.command, series.sender, 0)
            left = None if series.left is None else series.left - 1
            following = series._replace(left=left, next_utc_s=series.next_utc_s + series.every_s)
            self._series = None if left == 0 else following

    def _take(self, start_utc_s: float, name: str, sender: Sender, sequence: int) -> bool:
        with self._lock:
            if len(self._waiting) >= _MOST_WAITING:
                self.messages.append(f"{name}: no picture, because {_MOST_WAITING} wait to be drawn")
                return False
            self._waiting.append(Capture(self._count, start_utc_s, name, sender, sequence, self.settings))
        self._count += 1
        self._busy_until_utc_s = start_utc_s + self._span_s
        return True

    # --- messages -----------------------------------------------------------------------------------------------------

    def _send(self, number: float, parameter: float, now: _Now | None) -> int:
        """Send a message by its number; `parameter`: which picture; nothing is sent without `now`."""
        m = self._mavlink
        if number == m.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED and now is not None:
            image = self._taken.get(int(parameter)) if isfinite(parameter) else None
            if image is None:
                return int(m.MAV_RESULT_DENIED)
            self._replies.append(self._image(image, now))
            return int(m.MAV_RESULT_ACCEPTED)
        maker = self._makers.get(int(number)) if isfinite(number) else None
        if maker is None:
            return int(m.MAV_RESULT_UNSUPPORTED)
        # A number that a station leaves open is NaN in MAVLink.
        if number in self._of_streams and isfinite(parameter) and parameter not in {0, _STREAM_ID}:
            return int(m.MAV_RESULT_DENIED)
        if now is not None:
            self._replies.append(maker(now))
        return int(m.MAV_RESULT_ACCEPTED)

    def _send_on_request(self, number: int, command: Any, now: _Now) -> int:
        """Answer an older request for one message, whose parameter 1 is 1."""
        return self._send(number, 0.0, now if command.param1 else None)

    def _send_of_stream(self, number: int, command: Any, now: _Now) -> int:
        """Answer an older request for a message about a video stream, whose parameter 1 is the stream, 0 all."""
        return self._send(number, command.param1, now)

    def _resend(self, command: Any, now: _Now) -> int:
        return self._send(self._mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED, command.param1, now)

    def _heartbeat(self) -> Any:
        m = self._mavlink
        return m.MAVLink_heartbeat_message(
            m.MAV_TYPE_CAMERA, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE, _MAVLINK_VERSION
        )

    def _information(self, now: _Now) -> Any:
        m, facts = self._mavlink, self._facts
        major, minor, patch = map(int, re.findall(r"\d+", __version__)[:3])
        return m.MAVLink_camera_information_message(
            now.boot_ms,
            _characters("glstar", 32),
            _characters(facts.model, 32),
            major | minor << 8 | patch << 16,
            # A focal length and a sensor in mm are not known of all cameras.
            nan,
            nan,
            nan,
            facts.width_px,
            facts.height_px,
            0,
            m.CAMERA_CAP_FLAGS_CAPTURE_IMAGE | (0 if facts.video is None else m.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM),
            facts.definition[0],
            facts.definition[1].encode(),
            now.gimbal if facts.on_gimbal else 0,
        )

    def _settings(self, now: _Now) -> Any:
        m = self._mavlink
        return m.MAVLink_camera_settings_message(now.boot_ms, m.CAMERA_MODE_IMAGE, nan, nan)

    def _storage(self, now: _Now) -> Any:
        m, (total, available) = self._mavlink, self._facts.storage_mib()
        return m.MAVLink_storage_information_message(
            now.boot_ms, 1, 1, m.STORAGE_STATUS_READY, total, total - available, available, nan, nan
        )

    def _status(self, now: _Now) -> Any:
        is_exposing = now.utc_s is not None and now.utc_s < self._busy_until_utc_s
        series = self._series
        return self._mavlink.MAVLink_camera_capture_status_message(
            now.boot_ms,
            int(is_exposing) + (0 if series is None else 2),
            0,
            0.0 if series is None else series.every_s,
            0,
            self._facts.storage_mib()[1],
            self._count,
        )

    def _video_information(self, _: _Now) -> Any:
        m, video = self._mavlink, self._facts.video
        assert video is not None
        # Of a stream that is sent to a ground station, the port at which it listens.
        name, uri = b"night sky", str(video.port).encode()
        return m.MAVLink_video_stream_information_message(
            _STREAM_ID, 1, m.VIDEO_STREAM_TYPE_RTPUDP, *self._video(), name, uri, m.VIDEO_STREAM_ENCODING_H264
        )

    def _video_status(self, _: _Now) -> Any:
        return self._mavlink.MAVLink_video_stream_status_message(_STREAM_ID, *self._video())

    def _video(self) -> tuple[float, ...]:
        """Return flags, frame rate, size, bit rate (unknown), rotation and field of view of the video."""
        facts, video = self._facts, self._facts.video
        assert video is not None
        size_px = facts.width_px // 2 * 2, facts.height_px // 2 * 2
        running = self._mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING
        return running, video.frames_per_s, *size_px, 0, 0, round(facts.horizontal_field_deg)

    def _image(self, image: CapturedImage, now: _Now) -> Any:
        since_s = 0.0 if now.utc_s is None else now.utc_s - image.capture.start_utc_s
        url = image.url.encode()
        return self._mavlink.MAVLink_camera_image_captured_message(
            max(now.boot_ms - round(since_s * 1e3), 0),
            round(image.capture.start_utc_s * 1e6),
            0,
            round(image.latitude_deg * 1e7),
            round(image.longitude_deg * 1e7),
            round(image.height_m * 1e3),
            round(now.above_home_m * 1e3),
            list(image.q_ned_camera),
            image.capture.index,
            1 if url else 0,
            url if len(url) <= _URL_BYTES else url.rpartition(b"/")[2][-_URL_BYTES:],
        )


def _fifth(command: Any) -> float:
    """Return parameter 5 of a command: x of a COMMAND_INT."""
    return float(command.param5 if hasattr(command, "param5") else command.x)


def _characters(text: str, length: int) -> list[int]:
    """Return a text as numbers of a fixed length."""
    return list(text.encode()[: length - 1].ljust(length, b"\0"))
