"""A MAVLink camera component beside the vehicle."""

from glstar.link.camera.component import CAMERA_ID, CameraComponent, CameraFacts, Capture, CapturedImage, VideoFacts

__all__ = ["CAMERA_ID", "CameraComponent", "CameraFacts", "Capture", "CapturedImage", "VideoFacts"]
