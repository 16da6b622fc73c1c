"""The options of ``glstar live`` for what it sends besides requests: positions, and as a camera beside the vehicle."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import degrees
from pathlib import Path
from shutil import disk_usage
from typing import TYPE_CHECKING, Annotated

import typer

from glstar.camera.exposure import MAX_FRAMES
from glstar.cli.flightoptions import with_fields_as_options
from glstar.cli.flights.liveoutputs import LiveOutputs
from glstar.config import Config
from glstar.link import Endpoint, InjectedMessage, Injector
from glstar.link.camera import CAMERA_ID, CameraComponent, CameraFacts, CameraParameter, camera_definition

if TYPE_CHECKING:
    from glstar.export.imagefiles.formats import ImageFormat

_MIB = 2.0**20
# Limits of what ground stations can set: the longest times, s, and the largest gain.
_LONGEST_S, _LARGEST_GAIN = 3600.0, 1000.0

Inject = Annotated[
    bool,
    typer.Option(
        "--inject",
        help="Send the positions of --answers to the autopilot.",
    ),
]
InjectAs = Annotated[
    InjectedMessage | None,
    typer.Option(
        help="The message of --inject: EXTERNAL_POSITION_ESTIMATE (43003), GPS_INPUT or GLOBAL_POSITION_SENSOR.",
        show_default="external_position",
    ),
]
InjectHost = Annotated[
    str | None,
    typer.Option(
        help="The host or port of LINK, to send positions to a vehicle that is not simulated on this computer.",
        show_default=False,
    ),
]
InjectMaxKm = Annotated[
    float | None,
    typer.Option(
        min=0.1,
        help="How much farther than it can have flown since the last position a position of --inject may be, km.",
        show_default="200",
    ),
]
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

    @contextmanager
    def component(
        self,
        settings: Config,
        directory: Path | None,
        outputs: LiveOutputs,
        image_format: "ImageFormat | None",
        every_s: float | None,
    ) -> Iterator[CameraComponent | None]:
        """Serve the definition of the camera of the config, whose pictures lie in a directory; None without one.

        `outputs`: where its video goes; `every_s`: the interval of frames without commands of the command line.
        """
        if not self.mavlink_camera:
            if self.camera_id is not None or self.camera_delay is not None:
                raise typer.BadParameter("belong to --mavlink-camera", param_hint="--camera-id, --camera-delay")
            yield None
            return
        if directory is None:
            raise typer.BadParameter("writes its pictures: add --export DIRECTORY", param_hint="--mavlink-camera")
        if every_s is not None and not outputs.has_viewers:
            message = "is the interval of frames without commands; leave it out, or add --video or --foxglove"
            raise typer.BadParameter(message, param_hint="--every")
        from glstar.export.publish.outputs import PageServer  # noqa: PLC0415 - OpenCV

        model = str(settings.resolved()["camera"].get("preset", "camera"))
        parameters = _parameters(settings)
        version, content = camera_definition(model, parameters)
        camera, exposure = settings.camera(), settings.exposure
        with PageServer(content) as server:
            facts = CameraFacts(
                model=model,
                width_px=camera.width_px,
                height_px=camera.height_px,
                exposure_s=exposure.span_s,
                interval_s=exposure.interval_s,
                storage_mib=partial(_storage_mib, (directory.absolute(), *directory.absolute().parents)),
                horizontal_field_deg=degrees(camera.horizontal_field_rad),
                video=outputs.video_facts(settings),
                on_gimbal=settings.gimbal.mode == "log",
                parameters=parameters,
                changed=partial(_changed, settings, image_format),
                definition=(version, f"{server.address}/camera_{version}.xml"),
            )
            component = CAMERA_ID if self.camera_id is None else self.camera_id
            yield CameraComponent(facts, component=component, delay_s=self.camera_delay or 0.0)


def _storage_mib(folders: Iterable[Path]) -> tuple[float, float]:
    """Return the total and the available storage of the first folder that exists, MiB."""
    usage = disk_usage(next(folder for folder in folders if folder.exists()))
    return usage.total / _MIB, usage.free / _MIB


def _parameters(settings: Config) -> tuple[CameraParameter, ...]:
    """Return what ground stations can change in flight."""
    exposure, sensor = settings.exposure, settings.sensor()
    parameters = [
        CameraParameter(
            "CAM_SHUTTERSPD", "exposure.duration_s", exposure.duration_s, 0.001, _LONGEST_S, "s", "Exposure time"
        ),
        CameraParameter(
            "CAM_INTERVAL", "exposure.interval_s", exposure.interval_s, 0.01, _LONGEST_S, "s", "Time between pictures"
        ),
    ]
    # The sum of another number of short exposures would have another white.
    if exposure.stack == "mean":
        text = "Short exposures averaged"
        parameters.append(
            CameraParameter("CAM_FRAMES", "exposure.frames", exposure.frames, 1, MAX_FRAMES, "", text, is_whole=True)
        )
    if sensor.electrons is not None and exposure.exposure_control is None:
        gain = sensor.electrons.analogue_gain
        parameters.append(
            CameraParameter("CAM_GAIN", "sensor.analogue_gain", gain, 0.1, _LARGEST_GAIN, "", "Analogue gain")
        )
    return tuple(parameters)


def _changed(settings: Config, image_format: "ImageFormat | None", changes: Mapping[str, float]) -> tuple[float, float]:
    """Return span and interval of the exposures with other settings, s; raises ConfigError if they cannot be."""
    from glstar.export.imagefiles.formats import fit_format  # noqa: PLC0415 - OpenCV

    changed = settings.override(**changes)
    fit_format(image_format, changed.sensor(), summed=changed.exposure.signal_factor)
    return changed.exposure.span_s, changed.exposure.interval_s


@dataclass(frozen=True, slots=True)
class Injection:
    """Answers that are sent to the autopilot."""

    answers: str
    injector: Injector


@dataclass(frozen=True, slots=True)
class InjectionOptions:
    """How answers are sent to the autopilot, if they are to be."""

    inject: Inject = False
    inject_as: InjectAs = None
    inject_host: InjectHost = None
    inject_max_km: InjectMaxKm = None

    def injection(self, endpoint: Endpoint, answers: str | None, *, exports: bool) -> Injection | None:
        """Return the injection of answers into a link; None if there is to be none.

        `exports`: whether there are frames to be answered.
        """
        if not self.inject:
            of_injection = {
                "--inject-host": self.inject_host,
                "--inject-as": self.inject_as,
                "--inject-max-km": self.inject_max_km,
                "--answers": answers if exports else None,
            }
            for name, value in of_injection.items():
                if value is not None:
                    raise typer.BadParameter("belongs to --inject, without which nothing is sent", param_hint=name)
            return None
        if not exports:
            raise typer.BadParameter("answers are for frames: add --export or --latest-frame", param_hint="--inject")
        if answers is None:
            raise typer.BadParameter("says no source of answers: add --answers FILE, or -", param_hint="--inject")
        limits = {} if self.inject_max_km is None else {"max_km": self.inject_max_km}
        return Injection(answers, Injector(endpoint, self.inject_host, self.inject_as or "external_position", **limits))


def with_link_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameters ``injected`` and ``commanded`` of a command by one option for each of their fields."""
    command = with_fields_as_options(command, "injected", InjectionOptions)
    return with_fields_as_options(command, "commanded", CameraOptions)
