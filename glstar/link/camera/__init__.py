"""A MAVLink camera component beside the vehicle."""

from glstar.link.camera.component import CAMERA_ID, CameraComponent, CameraFacts, Capture, CapturedImage, VideoFacts
from glstar.link.camera.parameters import CameraParameter, camera_definition

__all__ = [
    "CAMERA_ID",
    "CameraComponent",
    "CameraFacts",
    "CameraParameter",
    "Capture",
    "CapturedImage",
    "VideoFacts",
    "camera_definition",
]
