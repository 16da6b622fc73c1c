"""glstar: long-exposure images of the night sky as a camera fixed to an aircraft records them.

>>> import glstar as gs
>>> flight = gs.open_flight(gs.asset("adelaide.BIN"))

The names in ``__all__`` are the public interface; ``glstar manual python`` describes them.  Each is imported when it is
first used: ``import glstar`` itself loads no OpenGL, no window toolkit and no MAVLink library.
"""

__version__ = "0.3.0"

# The module that defines each public name; __init__.pyi gives type checkers the same list.
_MODULES = {
    "AttitudeTrack": "glstar.flight",
    "CalibrationError": "glstar.errors",
    "Camera": "glstar.camera.model",
    "CatalogueError": "glstar.errors",
    "Config": "glstar.config",
    "ConfigError": "glstar.errors",
    "ContextError": "glstar.errors",
    "DetectedTrails": "glstar.compare.detection",
    "Environment": "glstar.export.environment",
    "ExportError": "glstar.errors",
    "Exposure": "glstar.camera.exposure",
    "Flight": "glstar.flight",
    "Frame": "glstar.render.scene.scene",
    "GLRenderer": "glstar.render.opengl",
    "GlstarError": "glstar.errors",
    "ImagesError": "glstar.errors",
    "LatestFrame": "glstar.export.publish.latest",
    "LatestFrameReader": "glstar.export.publish.latest",
    "LatestFrameWriter": "glstar.export.publish.latest",
    "Lens": "glstar.camera.distortion",
    "LinkError": "glstar.errors",
    "LinkTimeoutError": "glstar.errors",
    "LogFormatError": "glstar.errors",
    "Mount": "glstar.camera.model",
    "Observation": "glstar.export.environment",
    "Pose": "glstar.flight",
    "PositionTrack": "glstar.flight",
    "RenderError": "glstar.errors",
    "Renderer": "glstar.render.scene.scene",
    "Scene": "glstar.render.scene.scene",
    "ScriptedFlight": "glstar.telemetry.synthetic",
    "Sensor": "glstar.camera.sensor.sensor",
    "ShaderError": "glstar.errors",
    "Simulator": "glstar.render.simulator",
    "Site": "glstar.sky.place.site",
    "Sky": "glstar.sky.observed.stars",
    "StarCatalogue": "glstar.sky.catalogue.reading",
    "TelemetryError": "glstar.errors",
    "TrackRangeError": "glstar.errors",
    "asset": "glstar.system.resources",
    "calibrate_photographs": "glstar.calibrate.pipeline",
    "camera_from_file": "glstar.camera.camerafile",
    "camera_from_preset": "glstar.camera.presets",
    "detect_trails": "glstar.compare.detection",
    "frame_truth": "glstar.render.truth.frame",
    "open_flight": "glstar.telemetry",
    "read_truth": "glstar.export.truth.lines",
    "render_frame": "glstar.config",
    "scene_at_pose": "glstar.config",
}

__all__ = [
    "AttitudeTrack",
    "CalibrationError",
    "Camera",
    "CatalogueError",
    "Config",
    "ConfigError",
    "ContextError",
    "DetectedTrails",
    "Environment",
    "ExportError",
    "Exposure",
    "Flight",
    "Frame",
    "GLRenderer",
    "GlstarError",
    "ImagesError",
    "LatestFrame",
    "LatestFrameReader",
    "LatestFrameWriter",
    "Lens",
    "LinkError",
    "LinkTimeoutError",
    "LogFormatError",
    "Mount",
    "Observation",
    "Pose",
    "PositionTrack",
    "RenderError",
    "Renderer",
    "Scene",
    "ScriptedFlight",
    "Sensor",
    "ShaderError",
    "Simulator",
    "Site",
    "Sky",
    "StarCatalogue",
    "TelemetryError",
    "TrackRangeError",
    "asset",
    "calibrate_photographs",
    "camera_from_file",
    "camera_from_preset",
    "detect_trails",
    "frame_truth",
    "open_flight",
    "read_truth",
    "render_frame",
    "scene_at_pose",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module 'glstar' has no attribute {name!r}", name=name, obj=None)
    from importlib import import_module  # noqa: PLC0415 - import glstar loads nothing

    value: object = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names and those that every module has."""
    return sorted({*globals(), *__all__})
