"""``glstar calibrate --darks``: the noise of a sensor from dark frames and flat fields."""

import json
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import typer

from glstar.calibrate.photo.photograph import read_image
from glstar.calibrate.sensor.photontransfer import PhotonTransfer, images_in, photon_transfer
from glstar.cli.progress import progress_bar
from glstar.cli.verbosity import echo_note
from glstar.config.keys import toml_value
from glstar.errors import CalibrationError
from glstar.export.directory import explain_disk_errors
from glstar.system.files import write_atomically

# More hot pixels than this fraction of all are said: real sensors have some hundred in a million.
_MANY_HOT: Final = 0.01


def calibrate_from_darks(
    darks: Path, flats: Path | None, output: Path, bit_depth: int | None, *, as_json: bool
) -> None:
    """Measure a sensor, write its keys and maps, and report.

    `darks`: directory of dark frames; `flats`: directory of flat fields; `output`: the TOML file to write; the maps go
    beside it; `bit_depth`: bits of the images; None to find them; `as_json`: report as JSON.  Raises CalibrationError
    if the images cannot be used.
    """
    paths = [*images_in(darks), *(images_in(flats) if flats is not None else [])]
    count = len(images_in(darks))
    images = []
    with progress_bar("images") as on_image:
        for number, path in enumerate(paths, start=1):
            images.append(read_image(path, bit_depth=bit_depth, demosaiced=False))
            on_image(number, len(paths))
    depths = {image.bit_depth for image in images}
    if bit_depth is None and len(depths) > 1:
        # A dark frame in 16 bits does not reach the largest number of its converter, and a flat field may.
        raise CalibrationError(f"the images have {' and '.join(map(str, sorted(depths)))} bits; give --bit-depth")
    found = photon_transfer(images[:count], images[count:])
    keys, files = found.keys(max(depths)), _write_maps(found, output)
    lines = ["# From dark frames and flat fields by glstar calibrate.", "[sensor]"]
    lines += [f"{key} = {toml_value(value)}" for key, value in {**keys, **files}.items()]
    with explain_disk_errors(output):
        write_atomically(output, ("\n".join(lines) + "\n").encode())
    facts = {
        **keys,
        "dn_per_e_error": found.dn_per_e_error,
        "read_noise_dn": found.read_noise_dn,
        "prnu_fraction": found.prnu_fraction,
        "hot_pixels": found.hot,
        "dead_pixels": int(found.is_dead.sum()),
        "dark_frames": found.dark_frames,
        "flat_fields": found.flat_fields,
        **files,
    }
    hot = found.hot / found.dark_frame_dn.size
    if hot > _MANY_HOT:
        echo_note(f"note: {100 * hot:.1f} % of the pixels are hot: is the lens capped, and the sensor cool?")
    if as_json:
        typer.echo(json.dumps(facts))
    else:
        _report(found, output)


def _write_maps(found: PhotonTransfer, output: Path) -> dict[str, str]:
    """Write the maps beside the calibration, and return their names by key."""
    maps = {"dark_frame": (".dark.tiff", found.dark_frame_dn)}
    if found.flat_field is not None:
        maps["flat_field"] = (".flat.tiff", found.flat_field)
    names = {}
    for key, (suffix, pixels) in maps.items():
        names[key] = _write_image(output.with_suffix(suffix), pixels)
    if found.is_dead.any():
        names["defect_map"] = _write_image(output.with_suffix(".defects.png"), found.is_dead.astype(np.uint8) * 255)
    return names


def _write_image(path: Path, pixels: object) -> str:
    _, content = cv2.imencode(path.suffix, np.asarray(pixels))
    with explain_disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content.tobytes())
    return path.name


def _report(found: PhotonTransfer, output: Path) -> None:
    typer.echo(
        f"{found.dark_frames} dark frames: black level {found.black_level_dn:.2f} DN, read noise"
        f" {found.read_noise_dn:.3f} DN, {found.hot} hot pixels"
    )
    if found.dn_per_e is not None and found.prnu_fraction is not None:
        typer.echo(
            f"{found.flat_fields} flat fields: {found.dn_per_e:.4f} ± {found.dn_per_e_error:.4f} DN/e, so a read noise"
            f" of {found.read_noise_e:.2f} e; response {100 * found.prnu_fraction:.2f} % rms;"
            f" {int(found.is_dead.sum())} dead pixels"
        )
    else:
        typer.echo(
            "without flat fields (--flats) the gain in DN per electron is not known, and the read noise in DN only"
        )
    typer.echo(f"{output}: use it with [sensor] file, or copy its keys")
