"""An export as a ROS 2 bag or an MCAP file: images, camera, orientation, position and transforms.

============================  =========================  ==============================================================
topic                         message                    content
============================  =========================  ==============================================================
/camera/image_raw             sensor_msgs/Image          the frame, mono8 or mono16
/camera/camera_info           sensor_msgs/CameraInfo     its intrinsics
/imu/data                     sensor_msgs/Imu            the true attitude, from forward, left, up to east, north, up
/fix                          sensor_msgs/NavSatFix      the position
/tf, /tf_static               tf2_msgs/TFMessage         map (east, north, up) to base_link, that to camera_optical
/clock                        rosgraph_msgs/Clock        the time of the stamps, for nodes with ``use_sim_time``
/glstar/truth                 std_msgs/String            the line of ``truth.jsonl``, JSON
of an MCAP file:
/camera/image_raw/compressed  sensor_msgs/               the frame as PNG, without loss
                              CompressedImage
/camera/annotations           foxglove_msgs/             stars and their trails, for Foxglove to draw over the image
                              ImageAnnotations
============================  =========================  ==============================================================

Stamps are UTC of the middle of the exposure, at which attitude and star positions are given.  ROS 2 Humble and later
play the bag: its metadata have version 8, for rosbag2 before Jazzy refuses the empty list of QoS profiles of version 9.
The chunks of an MCAP file are compressed.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from glstar.arrays import Float
from glstar.errors import ExportError
from glstar.export.directory import explain_disk_errors, image_path
from glstar.export.imagefiles.formats import decode
from glstar.export.truth.lines import count_frames_of_truth, read_truth
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
    q_body_camera,
    q_world_body,
)
from glstar.sky.place.timescale import parse_utc
from glstar.system.imagefiles import encode_png

Step = Callable[[int, int], object]

# Unlimited, as rosbag2 writes it.
_FOREVER = QosTime(9223372036, 854775807)
# A subscriber that comes late gets the last message too, as tf2 asks of static transforms.
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, _FOREVER, _FOREVER,
    QosLiveliness.AUTOMATIC, _FOREVER, avoid_ros_namespace_conventions=False,
)  # fmt: skip
_QOS = {"/tf_static": (_LATCHED,)}
_UNKNOWN = np.array([-1.0, *[0.0] * 8])
# Messages of https://github.com/foxglove/foxglove-sdk, MIT: their fields without what the pictures do not have.
_ANNOTATIONS = {
    "Point2": "float64 x\nfloat64 y",
    "Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "CircleAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nfloat64 diameter\nfloat64 thickness\n"
        "foxglove_msgs/Color fill_color\nfoxglove_msgs/Color outline_color"
    ),
    "PointsAnnotation": (
        "builtin_interfaces/Time timestamp\nuint8 UNKNOWN=0\nuint8 POINTS=1\nuint8 LINE_LOOP=2\nuint8 LINE_STRIP=3\n"
        "uint8 LINE_LIST=4\nuint8 type\nfoxglove_msgs/Point2[] points\nfoxglove_msgs/Color outline_color\n"
        "foxglove_msgs/Color[] outline_colors\nfoxglove_msgs/Color fill_color\nfloat64 thickness"
    ),
    "TextAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nstring text\nfloat64 font_size\n"
        "foxglove_msgs/Color text_color\nfoxglove_msgs/Color background_color"
    ),
    "ImageAnnotations": (
        "foxglove_msgs/CircleAnnotation[] circles\nfoxglove_msgs/PointsAnnotation[] points\n"
        "foxglove_msgs/TextAnnotation[] texts"
    ),
}
_LINE_LIST = 4


def write_bag(directory: Path, output: Path, on_step: Step = lambda _done, _all: None) -> None:
    """Write the frames of an export and their truth as a ROS 2 bag.

    `output` is a new ``.mcap`` file, or else the directory of a new ROS 2 bag with SQLite storage. `on_step` is called
    with the number of frames written and of all frames. Raises ExportError if the output exists, a frame is missing, or
    the bag cannot be written.
    """
    if output.exists():
        raise ExportError(output, "exists already; name another file, or remove it")
    count = count_frames_of_truth(directory)
    with explain_disk_errors(output):
        folder = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.absolute().parent))
        try:
            is_mcap = output.suffix.lower() == ".mcap"
            plugin = StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3
            bag = folder / output.stem
            writer = Writer(bag, version=8, storage_plugin=plugin)
            if is_mcap:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                messages = _Messages(writer, for_foxglove=is_mcap)
                for number, line in enumerate(read_truth(directory)):
                    messages.write(line, _pixels(directory, line))
                    on_step(number + 1, count)
            (next(bag.glob("*.mcap")) if is_mcap else bag).replace(output)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _pixels(directory: Path, line: dict[str, Any]) -> NDArray[Any]:
    path = image_path(directory, line)
    try:
        return decode(path.read_bytes(), path.suffix)
    except (OSError, ValueError) as error:
        raise ExportError(path, f"cannot be read ({error}); run glstar export again to complete the set") from error


class _Messages:
    """Makes the messages of frames and writes them."""

    def __init__(self, writer: Writer, *, for_foxglove: bool) -> None:
        self._writer, self._store = writer, get_typestore(Stores.ROS2_HUMBLE)
        self._for_foxglove = for_foxglove
        for name, fields in _ANNOTATIONS.items():
            self._store.register(get_types_from_msg(fields, f"foxglove_msgs/msg/{name}"))
        self._connections: dict[str, Any] = {}
        self._has_static = False

    def write(self, line: dict[str, Any], pixels: NDArray[Any]) -> None:
        stamp_ns = round(parse_utc(line["utc_mid"]) * 1e6) * 1000
        optical = self._header(stamp_ns, CAMERA)
        self._put("/clock", "rosgraph_msgs/msg/Clock", stamp_ns, clock=optical.stamp)
        pixels = np.ascontiguousarray(pixels)
        encoding = "mono8" if pixels.dtype.itemsize == 1 else "mono16"
        self._put("/camera/image_raw", "sensor_msgs/msg/Image", stamp_ns,
            header=optical, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, is_bigendian=0,
            step=pixels.shape[1] * pixels.dtype.itemsize, data=pixels.reshape(-1).view(np.uint8),
        )  # fmt: skip
        self._put("/camera/camera_info", "sensor_msgs/msg/CameraInfo", stamp_ns, header=optical, **self._camera(line))
        q_enu_flu = q_world_body(line)
        zero = self._vector(0.0, 0.0, 0.0)
        self._put("/imu/data", "sensor_msgs/msg/Imu", stamp_ns, header=self._header(stamp_ns, BODY),
            orientation=self._quaternion(q_enu_flu), orientation_covariance=np.zeros(9), angular_velocity=zero,
            angular_velocity_covariance=_UNKNOWN, linear_acceleration=zero, linear_acceleration_covariance=_UNKNOWN,
        )  # fmt: skip
        site = line["site"]
        self._put("/fix", "sensor_msgs/msg/NavSatFix", stamp_ns, header=self._header(stamp_ns, BODY),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=0, service=1), latitude=site["latitude_deg"],
            longitude=site["longitude_deg"], altitude=site["height_m"], position_covariance=np.zeros(9),
            position_covariance_type=0,
        )  # fmt: skip
        self._transform("/tf", stamp_ns, WORLD, BODY, q_enu_flu)
        if not self._has_static:
            self._transform("/tf_static", stamp_ns, BODY, CAMERA, q_body_camera(line))
            self._has_static = True
        self._put("/glstar/truth", "std_msgs/msg/String", stamp_ns, data=json.dumps(line))
        if self._for_foxglove:
            png = np.frombuffer(encode_png(pixels), dtype=np.uint8)
            topic, kind = "/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage"
            self._put(topic, kind, stamp_ns, header=optical, format=f"{encoding}; png compressed ", data=png)
            topic, kind = "/camera/annotations", "foxglove_msgs/msg/ImageAnnotations"
            self._put(topic, kind, stamp_ns, **self._overlay(Overlay.of(line), optical.stamp))

    def _overlay(self, overlay: Overlay, stamp: Any) -> dict[str, Any]:
        """Return the fields of annotations that have a stamp."""
        clear, star, trail = (self._annotation("Color", r=r, g=g, b=b, a=a) for r, g, b, a in (NO_COLOUR, STAR, TRAIL))
        circles = [
            self._annotation(
                "CircleAnnotation", timestamp=stamp, position=self._point(circle.at), diameter=circle.diameter_px,
                thickness=THICKNESS_PX, fill_color=clear, outline_color=star,
            )
            for circle in overlay.circles
        ]  # fmt: skip
        lines = self._annotation(
            "PointsAnnotation", timestamp=stamp, type=_LINE_LIST,
            points=[self._point(point) for line in overlay.lines for point in line],
            outline_color=trail, outline_colors=[], fill_color=clear, thickness=THICKNESS_PX,
        )  # fmt: skip
        texts = [
            self._annotation(
                "TextAnnotation", timestamp=stamp, position=self._point(circle.beside), text=circle.label,
                font_size=FONT_PX, text_color=star, background_color=clear,
            )
            for circle in overlay.circles if circle.label
        ]  # fmt: skip
        return {"circles": circles, "points": [lines], "texts": texts}

    def _point(self, point: tuple[float, float]) -> Any:
        return self._annotation("Point2", x=point[0], y=point[1])

    def _annotation(self, kind: str, **fields: Any) -> Any:
        return self._make(f"foxglove_msgs/msg/{kind}", **fields)

    def _camera(self, line: dict[str, Any]) -> dict[str, Any]:
        camera = Calibration.of(line)
        region = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return {
            "height": camera.height_px, "width": camera.width_px, "distortion_model": camera.model,
            "d": camera.coefficients, "k": camera.K.reshape(-1), "r": np.eye(3).reshape(-1), "p": camera.P.reshape(-1),
            "binning_x": 0, "binning_y": 0, "roi": region,
        }  # fmt: skip

    def _transform(self, topic: str, stamp_ns: int, parent: str, child: str, q_parent_child: Float) -> None:
        rotation = self._quaternion(q_parent_child)
        moved = self._make("geometry_msgs/msg/Transform", translation=self._vector(0.0, 0.0, 0.0), rotation=rotation)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=moved,
        )
        self._put(topic, "tf2_msgs/msg/TFMessage", stamp_ns, transforms=[stamped])

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _quaternion(self, q: Float) -> Any:
        w, x, y, z = q.tolist()
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _put(self, topic: str, kind: str, stamp_ns: int, **fields: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=_QOS.get(topic, ())
            )
        message = self._store.serialize_cdr(self._make(kind, **fields), kind)
        self._writer.write(self._connections[topic], stamp_ns, message)
