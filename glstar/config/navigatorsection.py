"""``[navigator]``: what the aircraft believes, as ``nav.jsonl`` gives it to a solver."""

from math import radians
from typing import Literal

from pydantic import Field

from glstar.camera.model import Mount
from glstar.config.section import Section
from glstar.flight.navigator import AttitudeErrorModel, MountError

__all__ = ["NavigatorSection"]

_DEGREES = "a number of degrees"
_SPREAD = "a number of degrees, 0 or more"


class NavigatorSection(Section):
    """``[navigator]``: estimated attitude, mount, clock and position; without any key there is no ``nav.jsonl``.

    Attributes
    ----------
    attitude : str
        ``"model"``: the true attitude with the errors of the keys below; else a message of the log, such as ``"ATT"``,
        with the same errors on top (none by default).
    seed : int
        Of the random errors.
    """

    attitude: str = Field(default="model", min_length=1, description='"model" or the name of a message, such as "ATT"')
    roll_bias_deg: float = Field(default=0.0, description=_DEGREES)
    pitch_bias_deg: float = Field(default=0.0, description=_DEGREES)
    yaw_bias_deg: float = Field(default=0.0, description=_DEGREES)
    bias_sigma_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    drift_sigma_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    drift_time_s: float = Field(default=60.0, gt=0, description="a positive number of seconds")
    turn_coupling: float = Field(default=0.0, ge=0, le=1, description="a number from 0 to 1")
    perlin_deg: float = Field(default=0.0, ge=0, description=_SPREAD)
    perlin_time_s: float = Field(default=10.0, gt=0, description="a positive number of seconds")
    perlin_octaves: int = Field(default=4, ge=1, le=12, description="a whole number from 1 to 12")
    mount_roll_error_deg: float = Field(default=0.0, description=_DEGREES)
    mount_pitch_error_deg: float = Field(default=0.0, description=_DEGREES)
    mount_yaw_error_deg: float = Field(default=0.0, description=_DEGREES)
    clock_offset_s: float = Field(default=0.0, ge=-3600, le=3600, description="a number of seconds, -3600 to 3600")
    gps: Literal["known", "denied"] = "denied"
    seed: int = Field(default=0, ge=0, description="a whole number, 0 or more")

    @property
    def errors(self) -> AttitudeErrorModel:
        """The errors of the estimated attitude."""
        return AttitudeErrorModel(
            bias_rad=(radians(self.roll_bias_deg), radians(self.pitch_bias_deg), radians(self.yaw_bias_deg)),
            bias_sigma_rad=radians(self.bias_sigma_deg),
            drift_sigma_rad=radians(self.drift_sigma_deg),
            drift_time_s=self.drift_time_s,
            turn_coupling=self.turn_coupling,
            perlin_rad=radians(self.perlin_deg),
            perlin_time_s=self.perlin_time_s,
            perlin_octaves=self.perlin_octaves,
        )

    @property
    def is_perfect(self) -> bool:
        """Whether the aircraft knows its true attitude, mount and time."""
        return (
            self.attitude == "model"
            and self.errors == AttitudeErrorModel()
            and self.mount_error == MountError()
            and self.clock_offset_s == 0
        )

    def real_mount(self, nominal: Mount) -> Mount:
        """Return the mount of the camera that draws the frames.

        Parameters
        ----------
        nominal : Mount
            As in ``[mount]``, which is what the navigator knows.

        Returns
        -------
        Mount
        """
        if self.mount_error == MountError():
            return nominal
        return Mount.from_matrix(self.mount_error.applied(nominal.C_camera_body), reading=nominal.reading)

    @property
    def mount_error(self) -> MountError:
        """The rotation of the real camera against the nominal mount."""
        return MountError(
            radians(self.mount_roll_error_deg), radians(self.mount_pitch_error_deg), radians(self.mount_yaw_error_deg)
        )
