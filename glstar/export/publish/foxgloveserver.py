"""Frames for Foxglove over a WebSocket: the image, the camera, and the truth drawn over the image.

==================  ==========================  ======================================================================
topic               schema                      content
==================  ==========================  ======================================================================
/camera/image       foxglove.CompressedImage    the frame as PNG with 8 bits
/camera/calibration foxglove.CameraCalibration  its lens and camera matrix
/camera/annotations foxglove.ImageAnnotations   stars, bodies and satellites as circles, their trails as lines
/tf                 foxglove.FrameTransforms    map (east, north, up) to base_link, that to camera_optical
/fix                foxglove.LocationFix        the position
==================  ==========================  ======================================================================

Times are UTC of the middle of the exposure, which is also the time of the server.
"""

from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.export.imagefiles.formats import encode
from glstar.export.imagefiles.processing import shown_as_8_bits
from glstar.export.publish.stream import host_and_port
from glstar.export.truth.overlays import (
    BODY,
    CAMERA,
    FONT_PX,
    NO_COLOUR,
    STAR,
    THICKNESS_PX,
    TRAIL,
    WORLD,
    Calibration,
    Overlay,
    Point,
    q_body_camera,
    q_world_body,
)
from glstar.sky.place.timescale import parse_utc
from glstar.system.installation import install_command

# Foxglove's name of the lens that ROS calls equidistant.
_MODELS = {"equidistant": "kannala_brandt"}


class FoxgloveServer:
    """Serves frames with their truth to the Foxglove app; a context manager.

    `where` is ``PORT`` on this computer, or ``HOST:PORT``.  The images are shown as by `MjpegServer`; `summed` is the
    number of short exposures whose sum a frame is.  A client that is slower than the frames misses some.  Raises
    ConfigError if the address is not valid or in use, or foxglove-sdk is not installed.
    """

    needs_nav = False

    def __init__(self, where: str, sensor: Sensor, *, summed: int = 1) -> None:
        self._foxglove, self._sensor, self._summed = _library(), sensor, summed
        from foxglove import channels, messages  # noqa: PLC0415 - an extra

        self._messages = messages
        host, port = self.address = foxglove_address(where)
        # The channels close with their context, which nothing else keeps.
        context = self._context = self._foxglove.Context()
        self._image = channels.CompressedImageChannel("/camera/image", context=context)
        self._calibration = channels.CameraCalibrationChannel("/camera/calibration", context=context)
        self._annotations = channels.ImageAnnotationsChannel("/camera/annotations", context=context)
        self._transforms = channels.FrameTransformsChannel("/tf", context=context)
        self._fix = channels.LocationFixChannel("/fix", context=context)
        capabilities = [self._foxglove.websocket.Capability.Time]
        try:
            self._server = self._foxglove.start_server(
                name="glstar", host=host, port=port, capabilities=capabilities, context=context
            )
        except (OSError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ConfigError(f"--foxglove {where} cannot be opened ({reason})") from error
        self._is_open = True

    def write(self, pixels: NDArray[Any], truth: bytes, _nav: dict[str, Any]) -> None:
        """Send a frame to all clients; `pixels` (height, width) uint8 or uint16; `truth`: the line of its truth."""
        line, m = orjson.loads(truth), self._messages
        stamp_us = round(parse_utc(line["utc_mid"]) * 1e6)
        stamp = m.Timestamp(sec=stamp_us // 10**6, nsec=stamp_us % 10**6 * 1000)
        at = {"log_time": stamp_us * 1000}
        png = encode(shown_as_8_bits(pixels, self._sensor, summed=self._summed), "png")
        camera = Calibration.of(line)
        calibration = m.CameraCalibration(
            timestamp=stamp,
            frame_id=CAMERA,
            width=camera.width_px,
            height=camera.height_px,
            distortion_model=_MODELS.get(camera.model, camera.model),
            D=camera.coefficients.tolist(),
            K=camera.K.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=camera.P.ravel().tolist(),
        )
        site = line["site"]
        fix = m.LocationFix(
            timestamp=stamp,
            frame_id=BODY,
            latitude=site["latitude_deg"],
            longitude=site["longitude_deg"],
            altitude=site["height_m"],
        )
        turns = [(WORLD, BODY, q_world_body(line)), (BODY, CAMERA, q_body_camera(line))]
        self._server.broadcast_time(stamp_us * 1000)
        self._transforms.log(m.FrameTransforms(transforms=[self._transform(stamp, *turn) for turn in turns]), **at)
        self._fix.log(fix, **at)
        self._calibration.log(calibration, **at)
        self._annotations.log(self._overlay(Overlay.of(line), stamp), **at)
        self._image.log(m.CompressedImage(timestamp=stamp, frame_id=CAMERA, data=png, format="png"), **at)

    def _transform(self, stamp: Any, parent: str, child: str, q_parent_child: Float) -> Any:
        m, (w, x, y, z) = self._messages, q_parent_child.tolist()
        return m.FrameTransform(
            timestamp=stamp,
            parent_frame_id=parent,
            child_frame_id=child,
            translation=m.Vector3(x=0.0, y=0.0, z=0.0),
            rotation=m.Quaternion(x=x, y=y, z=z, w=w),
        )

    def _overlay(self, overlay: Overlay, stamp: Any) -> Any:
        m = self._messages
        clear, star, trail = (m.Color(r=r, g=g, b=b, a=a) for r, g, b, a in (NO_COLOUR, STAR, TRAIL))
        circles = [
            m.CircleAnnotation(
                timestamp=stamp,
                position=self._point(circle.at),
                diameter=circle.diameter_px,
                thickness=THICKNESS_PX,
                fill_color=clear,
                outline_color=star,
            )
            for circle in overlay.circles
        ]
        lines = m.PointsAnnotation(
            timestamp=stamp,
            type=m.PointsAnnotationType.LineList,
            points=[self._point(point) for line in overlay.lines for point in line],
            outline_color=trail,
            thickness=THICKNESS_PX,
        )
        texts = [
            m.TextAnnotation(
                timestamp=stamp,
                position=self._point(circle.beside),
                text=circle.label,
                font_size=FONT_PX,
                text_color=star,
                background_color=clear,
            )
            for circle in overlay.circles
            if circle.label
        ]
        return m.ImageAnnotations(circles=circles, points=[lines], texts=texts)

    def _point(self, point: Point) -> Any:
        return self._messages.Point2(x=point[0], y=point[1])

    def close(self) -> None:
        """End the server; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def foxglove_address(where: str) -> tuple[str, int]:
    """Return the host and port of ``PORT`` or ``HOST:PORT``; raises ConfigError if they are not valid."""
    address = host_and_port(where.removeprefix("ws://"), "")
    if address is None:
        raise ConfigError(f"--foxglove {where} is no address; write a port such as 8765, or HOST:PORT")
    return address[0].strip("[]"), address[1]


def _library() -> Any:
    try:
        import foxglove  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"--foxglove needs foxglove-sdk: {install_command('foxglove')}") from error
    return foxglove


def check_foxglove(where: str) -> None:
    """Raise ConfigError if an address is not valid, or foxglove-sdk is not installed."""
    foxglove_address(where)
    _library()
