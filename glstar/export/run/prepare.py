"""Preparation of an export: flights are read, and their frames are planned."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from glstar.config import Config
from glstar.errors import ConfigError, FlightTooShortError, LogFormatError
from glstar.export.frame import FrameTask
from glstar.export.imagefiles.formats import ImageFormat, fit_format
from glstar.export.imagefiles.masks import masks_of
from glstar.export.plan.dataset import DataSetFrames, file_hash, largest_sum
from glstar.export.plan.frames import ExportOptions, FlightFrames, Frames, plan_frames
from glstar.export.plan.manifest import OmittedLog, describe, describe_data_set
from glstar.export.run.export import Export
from glstar.flight import Flight
from glstar.sky.catalogue.reading import StarCatalogue

_ALL = ExportOptions()


def prepare_export(
    config: Config,
    flight_path: Path,
    directory: Path,
    options: ExportOptions = _ALL,
    *,
    flight: Flight | None = None,
    only: int | None = None,
) -> Export:
    """Read a flight and plan its frames; nothing is drawn or written yet.

    `flight` is the content of the log, if it has been read already; `only` is the number of the only frame to draw.
    Exposures that span a gap in the log are listed in `Frames.skipped`. Raises ConfigError if no exposure fits into the
    flight, the sensor has more bits than the format, or the only frame is skipped; LogFormatError if the log cannot be
    read; CatalogueError if the star catalogue is unknown.
    """
    flight = config.open_flight(flight_path) if flight is None else flight
    plan = plan_frames(flight, config.exposure, start_s=options.start_s, stop_s=options.stop_s, frames=options.frames)
    image_format, sensor = fit_format(options.image_format, config.sensor(), summed=config.exposure.signal_factor)
    chosen = plan if only is None else plan.only(only)
    frames = FlightFrames(config.simulator(flight, sensor=sensor), chosen, config.exposure.exposure_control)
    manifest = describe(config, flight_path, flight, sensor, replace(options, image_format=image_format), plan)
    return Export(_task(config, frames, directory, image_format, options), manifest)


def prepare_data_set(
    config: Config,
    flight_paths: Sequence[Path],
    directory: Path,
    options: ExportOptions = _ALL,
    *,
    strict: bool = True,
) -> Export:
    """Read flights and plan the frames of a data set: each flight under each sample of the config's sweep.

    Unless `strict`, a log that cannot be read or is too short for an exposure is left out and listed in
    `Export.omitted_logs` and in the manifest, as long as one log remains. Raises ConfigError if the exposure of a
    sample does not fit into its flight, or a sensor has more bits than the format; LogFormatError if a log cannot be
    read; CatalogueError if a star catalogue is unknown.
    """
    image_format, sensor = fit_format(options.image_format, config.sensor(), summed=largest_sum(config))
    catalogues = _catalogues(config, image_format)
    hashes = tuple((path, file_hash(path)) for path in config.files)
    paths, flights, omitted = _read_flights(config, flight_paths, strict=strict)
    while True:
        part = options.start_s, options.stop_s, options.frames
        frames = DataSetFrames(config, tuple(flights), catalogues, image_format, *part, hashes)
        try:
            frames.check_samples_fit()
            break
        except FlightTooShortError as error:
            if strict or len(flights) == 1:
                raise
            # The random draws of later flights depend on their index, so all are checked again.
            del flights[error.which]
            omitted.append(OmittedLog(paths.pop(error.which), str(error)))
    manifest = describe_data_set(paths, frames, sensor, replace(options, image_format=image_format), omitted)
    task = _task(config, frames, directory, image_format, options)
    return Export(task, manifest, tuple(omitted))


def _task(
    config: Config, frames: Frames, directory: Path, image_format: ImageFormat, options: ExportOptions
) -> FrameTask:
    masks = masks_of(config, masks=options.masks)
    if options.exif and image_format == "fits":
        raise ConfigError("FITS files state time, exposure and position in their header; leave out --exif")
    return FrameTask(frames, directory, image_format, options.noiseless, options.seed, masks=masks, exif=options.exif)


def _catalogues(config: Config, image_format: ImageFormat) -> dict[str, StarCatalogue]:
    """Return each catalogue of the sweep to its faintest magnitude; raise if a sensor does not fit the format."""
    faintest: dict[str, float] = {}
    for one in (config, *map(config.at, config.sweep.extremes())):
        fit_format(image_format, one.sensor(), summed=largest_sum(config))
        faintest[one.sky.catalogue] = max(faintest.get(one.sky.catalogue, -np.inf), one.sky.vmag_limit)
    return {name: StarCatalogue.open(name).brighter_than(vmag) for name, vmag in faintest.items()}


def _read_flights(
    config: Config, flight_paths: Sequence[Path], *, strict: bool
) -> tuple[list[Path], list[Flight], list[OmittedLog]]:
    """Return the logs that can be read, their flights, and the other logs; raise if no log can be read."""
    paths, flights, omitted = [], [], []
    errors: list[LogFormatError] = []
    for path in flight_paths:
        try:
            flights.append(config.open_flight(path))
        except LogFormatError as error:
            if strict or len(flight_paths) == 1:
                raise
            errors.append(error)
            omitted.append(OmittedLog(path, str(error).removeprefix(f"{path}: ")))
        else:
            paths.append(path)
    if not flights:
        raise LogFormatError(errors[0].path, f"{str(errors[0]).removeprefix(f'{errors[0].path}: ')} (no log is left)")
    return paths, flights, omitted
