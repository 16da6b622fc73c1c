"""The options of ``glstar live`` for a MAVLink camera beside the vehicle."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from shutil import disk_usage
from typing import Annotated

import typer

from glstar.cli.flightoptions import with_fields_as_options
from glstar.config import Config
from glstar.link.camera import CAMERA_ID, CameraComponent, CameraFacts

_MIB = 2.0**20

MavlinkCamera = Annotated[
    bool,
    typer.Option(
        "--mavlink-camera",
        help="Be a MAVLink camera beside the vehicle: --export the pictures that ground stations and the autopilot"
        " command, each at its command, instead of one every some seconds.",
    ),
]
CameraId = Annotated[
    int | None,
    typer.Option(help="MAVLink component of that camera.", min=1, max=255, show_default=str(CAMERA_ID)),
]
CameraDelay = Annotated[
    float | None,
    typer.Option(help="Time from a command to the opening of its shutter, s.", min=0.0, max=60.0, show_default="0"),
]


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """The camera that others command, if there is to be one."""

    mavlink_camera: MavlinkCamera = False
    camera_id: CameraId = None
    camera_delay: CameraDelay = None

    def component(self, settings: Config, directory: Path | None, *, has_interval: bool) -> CameraComponent | None:
        """Return the camera of the config, whose pictures lie in a directory; None without one.

        `has_interval`: whether the command line gives the interval of frames that nobody commands.
        """
        if not self.mavlink_camera:
            if self.camera_id is not None or self.camera_delay is not None:
                raise typer.BadParameter("belong to --mavlink-camera", param_hint="--camera-id, --camera-delay")
            return None
        if directory is None:
            raise typer.BadParameter("writes its pictures: add --export DIRECTORY", param_hint="--mavlink-camera")
        if has_interval:
            message = "is the interval of frames that nobody commands; leave it out of --mavlink-camera"
            raise typer.BadParameter(message, param_hint="--every")
        folders = (directory.absolute(), *directory.absolute().parents)

        def storage_mib() -> tuple[float, float]:
            usage = disk_usage(next(folder for folder in folders if folder.exists()))
            return usage.total / _MIB, usage.free / _MIB

        camera, exposure = settings.camera(), settings.exposure
        facts = CameraFacts(
            model=str(settings.resolved()["camera"].get("preset", "camera")),
            width_px=camera.width_px,
            height_px=camera.height_px,
            exposure_s=exposure.span_s,
            interval_s=exposure.interval_s,
            storage_mib=storage_mib,
        )
        component = CAMERA_ID if self.camera_id is None else self.camera_id
        return CameraComponent(facts, component=component, delay_s=self.camera_delay or 0.0)


def with_camera_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter ``commanded: CameraOptions`` of a command by one option for each field."""
    return with_fields_as_options(command, "commanded", CameraOptions)
