from typing import Final

from glstar.camera.camerafile import camera_from_file as camera_from_file
from glstar.camera.distortion import Lens as Lens
from glstar.camera.exposure import Exposure as Exposure
from glstar.camera.model import Camera as Camera
from glstar.camera.model import Mount as Mount
from glstar.camera.presets import camera_from_preset as camera_from_preset
from glstar.camera.sensor import Sensor as Sensor
from glstar.config import Config as Config
from glstar.config import render_frame as render_frame
from glstar.config import scene_at_pose as scene_at_pose
from glstar.errors import CalibrationError as CalibrationError
from glstar.errors import CatalogueError as CatalogueError
from glstar.errors import ConfigError as ConfigError
from glstar.errors import ContextError as ContextError
from glstar.errors import ExportError as ExportError
from glstar.errors import GlstarError as GlstarError
from glstar.errors import ImagesError as ImagesError
from glstar.errors import LinkError as LinkError
from glstar.errors import LinkTimeoutError as LinkTimeoutError
from glstar.errors import LogFormatError as LogFormatError
from glstar.errors import RenderError as RenderError
from glstar.errors import ShaderError as ShaderError
from glstar.errors import TelemetryError as TelemetryError
from glstar.errors import TrackRangeError as TrackRangeError
from glstar.export.latestframe import LatestFrame as LatestFrame
from glstar.export.latestframe import LatestFrameReader as LatestFrameReader
from glstar.export.latestframe import LatestFrameWriter as LatestFrameWriter
from glstar.export.readtruth import read_truth as read_truth
from glstar.flight import AttitudeTrack as AttitudeTrack
from glstar.flight import Flight as Flight
from glstar.flight import PositionTrack as PositionTrack
from glstar.render.opengl import GLRenderer as GLRenderer
from glstar.render.scene import Frame as Frame
from glstar.render.scene import Renderer as Renderer
from glstar.render.scene import Scene as Scene
from glstar.render.simulator import Simulator as Simulator
from glstar.render.truth import frame_truth as frame_truth
from glstar.sky.catalogue import StarCatalogue as StarCatalogue
from glstar.sky.observed import Sky as Sky
from glstar.sky.site import Site as Site
from glstar.system.resources import asset as asset
from glstar.telemetry import open_flight as open_flight
from glstar.telemetry.scripted import ScriptedFlight as ScriptedFlight

__version__: Final[str]
