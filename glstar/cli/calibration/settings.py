"""The options of ``glstar calibrate``, passed from the command line to the run."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """The options of ``glstar calibrate``, as given."""

    config: Path | None
    fov_deg: float | None
    exposures_s: list[float] | None
    utc: list[str] | None
    site_deg: dict[str, float | None]
    attitude_deg: dict[str, float | None]
    flight: Path | None
    labels: Path | None
    channel: str
    bit_depth: int | None
    criterion: str
    lens: str
    fit_lens: bool
    geometry_only: bool
    shape: bool
    twin: bool = False
    extinction: str = "none"
    fit_readout: bool = False
    gamma: str | None = None
