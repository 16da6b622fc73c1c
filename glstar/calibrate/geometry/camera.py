"""Camera and attitude of one photograph, or of several by one camera, without the sensor: stars may be blurred."""

import csv
import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from glstar import __version__
from glstar.calibrate.geometry.lensfit import SharedLensFit, centroid_noise_px
from glstar.calibrate.identify.platesolution import ZENITH_REFRACTION, Matches, ReferenceStars
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.detection import DetectedStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.camerafile import camera_warnings
from glstar.camera.sensor.sensor import Sensor
from glstar.config.keys import toml_value
from glstar.sky.place.apparent import right_ascension_declination
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad

_STAR_COLUMNS = (
    "catalogue", "star_id", "name", "vmag", "x_px", "y_px", "residual_x_px", "residual_y_px",
    "signal_to_noise", "saturated",
)  # fmt: skip
# Centroids have errors of at most sigma / 5: residuals above this fraction of sigma indicate a wrong camera model.
_MISPLACED_SIGMA = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class GeometryCalibration:
    """The camera and the attitude of one photograph."""

    image: Photograph
    detected: DetectedStars
    reference: ReferenceStars
    matches: Matches
    method: str  # How the stars were identified
    notes: tuple[Note, ...]  # Remarks for the user

    @property
    def boresight_rad(self) -> tuple[float, float]:
        """Right ascension and declination (ICRS) that the optical axis points at, rad."""
        axis = self.matches.solution.C_camera_eq[2] @ self.reference.stars.C_eq_icrs
        ra_rad, dec_rad = right_ascension_declination(axis)
        return float(ra_rad), float(dec_rad)

    @property
    def facts(self) -> dict[str, Any]:
        """Image, detection and identification, as JSON-serialisable values."""
        matches, detected = self.matches, self.detected
        solution, camera = matches.solution, matches.solution.camera
        ra_rad, dec_rad = self.boresight_rad
        boresight = {"ra_deg": np.rad2deg(ra_rad), "dec_deg": np.rad2deg(dec_rad)}
        axis_eq = solution.C_camera_eq[2]
        if self.reference.zenith_error_rad is not None:
            boresight |= {"altitude_deg": float(np.rad2deg(np.arcsin(axis_eq @ self.reference.zenith_eq)))}
            boresight |= {"zenith_error_deg": float(np.rad2deg(self.reference.zenith_error_rad))}
        if self.reference.C_ned_eq is not None:
            azimuth, altitude = ned_to_azimuth_altitude_rad(self.reference.C_ned_eq @ axis_eq)
            boresight |= {"azimuth_deg": np.rad2deg(float(azimuth)), "altitude_deg": np.rad2deg(float(altitude))}
        return {
            "image": {
                "file": self.image.path.name,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "bit_depth": self.image.bit_depth,
                "channel": self.image.channel,
            },
            "detection": {
                "stars": len(detected),
                "saturated": int(detected.saturated.sum()),
                "hot_pixels": detected.hot_pixels,
                "at_the_edge": detected.at_the_edge,
                "shapeless": detected.shapeless,
            },
            "identification": {
                "method": self.method,
                "stars_on_image": len(matches.predicted),
                "identified": len(matches),
                "expected_by_chance": matches.expected_by_chance,
                "rms_px": matches.rms_px,
                "median_px": float(np.median(np.linalg.norm(matches.residual_px, axis=1))),
                "centroid_noise_px": centroid_noise_px(detected, matches.detection),
                "chance": matches.chance,
                "mirrored": solution.mirrored,
                "fx_px": camera.fx_px,
                "fy_px": camera.fy_px,
                "field_of_view_deg": float(np.rad2deg(camera.horizontal_field_rad)),
                "cx_px": camera.cx_px,
                "cy_px": camera.cy_px,
                "radial_distortion_k1": solution.k1,
                "standard_error": matches.standard_error,
                **({} if camera.lens is None else camera.lens.keys),
                **({} if matches.readout is None else matches.readout.to_json()),
                "C_camera_icrs": (solution.C_camera_eq @ self.reference.stars.C_eq_icrs).tolist(),
                **{key: float(value) for key, value in boresight.items()},
            },
        }

    def to_toml(self) -> str:
        """Return the camera as TOML, for ``--config``: ``[camera]``, with its origin as a comment."""
        head = [
            f"Camera by glstar {__version__} from {self.image.path.name}: {len(self.matches)} stars identified"
            f" ({self.method}).  Geometry only: no sensor.",
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, None, self.matches)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values, as those of a sensor are, with ``sensor`` None."""
        return {
            "schema": 2,
            "glstar": __version__,
            **self.facts,
            "sensor": None,
            "notes": [note.text for note in self.notes],
        }

    def to_csv(self) -> str:
        """Return a line for each identified star, in the order of catalogue brightness; lengths in px."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_STAR_COLUMNS)
        stars, detected = self.reference.stars, self.detected
        for star, k, residual in zip(self.matches.star, self.matches.detection, self.matches.residual_px, strict=True):
            numbers = (*detected.xy_px[k], *residual, detected.signal_to_noise[k])
            writer.writerow(
                [stars.catalogue, int(stars.star_id[star]), stars.name[star], f"{stars.vmag[star]:.2f}"]
                + [f"{number:.4f}" for number in numbers]
                + [int(detected.saturated[k])]
            )
        return text.getvalue()


def calibrate_geometry(
    image: Photograph,
    detected: DetectedStars,
    reference: ReferenceStars,
    matches: Matches,
    *,
    method: str,
    notes: tuple[Note, ...] = (),
) -> GeometryCalibration:
    """Return the camera of one photograph with identified stars, which may be blurred or saturated.

    `method`: how the stars were identified; `notes`: other remarks for the user.
    """
    all_notes = (
        *notes,
        *matches.notes,
        *camera_notes(matches, detected.psf_sigma_px),
        *refraction_notes(reference, matches),
    )
    if detected.drawn_out_px:
        all_notes = (
            *all_notes,
            Note(
                NoteKind.CAMERA,
                f"the stars are elongated by about {detected.drawn_out_px:.1f} px: the attitude is that of mid-exposure"
                " if the camera moved steadily",
            ),
        )
    return GeometryCalibration(image, detected, reference, matches, method, all_notes)


def refraction_notes(reference: ReferenceStars, matches: Matches) -> tuple[Note, ...]:
    """Return a note on a zenith from refraction, or where refraction is ignored and the focal length would show it."""
    if reference.zenith_error_rad is not None:
        from_axis = np.arccos(np.clip(matches.solution.C_camera_eq[2] @ reference.zenith_eq, -1, 1))
        declination_deg, error_deg = np.rad2deg([np.arcsin(reference.zenith_eq[2]), reference.zenith_error_rad])
        text = (
            f"time or site is unknown; refraction shows the zenith {np.rad2deg(from_axis):.0f} ± {error_deg:.0f} deg"
            f" from the optical axis, at declination {declination_deg:.0f} deg (the latitude of the site): camera and"
            " horizon are those of this zenith, whose error is in the standard errors; give --utc, --lat and --lon"
        )
        return (Note(NoteKind.CAMERA, text),)
    error_px = matches.standard_error.get("fx_px")
    unknown_px = reference.refraction_error(matches.solution.C_camera_eq[2])[0] * matches.solution.camera.fx_px
    # A larger scatter of the stars hides it.
    if not unknown_px or error_px is None or error_px > 2 * unknown_px:
        return ()
    text = (
        "time or site is unknown, so refraction is not removed: the focal length is"
        f" {ZENITH_REFRACTION:.2%} too short if the camera pointed at the zenith, and more at lower altitudes; the"
        " standard errors include this down to 30 deg above the horizon; give --utc, --lat and --lon"
    )
    return (Note(NoteKind.CAMERA, text),)


def camera_notes(matches: Matches, psf_sigma_px: float) -> tuple[Note, ...]:
    """Return remarks on a doubtful camera; `psf_sigma_px`: width of the stars, px."""
    camera = matches.solution.camera
    texts = [*camera_warnings(camera)]
    if matches.rms_px > _MISPLACED_SIGMA * psf_sigma_px:
        model = "a pinhole" if camera.lens is None else f"such a {camera.lens.model} lens"
        texts.append(
            f"the fitted camera is off by {matches.rms_px:.2f} px rms from the stars, although a sigma of"
            f" {psf_sigma_px:.2f} px allows far better centroids: it is not exactly {model}, or the image was smeared;"
            " towards the corners, and where no star was identified, the error may be larger"
        )
    return tuple(Note(NoteKind.CAMERA, text) for text in texts)


def _flat_keys(sensor: Sensor) -> dict[str, Any]:
    """Return the keys of ``[sensor]`` and of its effects."""
    keys = {key: value for key, value in sensor.keys.items() if key != "effects"}
    own = {key: value for key, value in sensor.effects.items() if key.startswith("sensor.")}
    return keys | {key.removeprefix("sensor."): value for key, value in own.items()}


def _other_tables(sensor: Sensor | None) -> list[str]:
    """Return the lines of effects in tables of their own, such as ``[lens]``."""
    others = {} if sensor is None else {key: v for key, v in sensor.effects.items() if not key.startswith("sensor.")}
    lines = []
    for section in dict.fromkeys(key.partition(".")[0] for key in others):
        keys = {key.partition(".")[2]: value for key, value in others.items() if key.startswith(f"{section}.")}
        lines += ["", f"[{section}]", *(f"{key} = {toml_value(value)}" for key, value in keys.items())]
    return lines


def calibration_toml(
    head: list[str],
    sensor: Sensor | None,
    matches: Matches,
    *,
    sensor_error: dict[str, float] | None = None,
    star_brightness: str | None = None,
) -> str:
    """Return a calibration as TOML: ``[sensor]``, if there is one, and ``[camera]``.

    `head`: comments at the top; `matches`: their solution holds the camera, and k1 if it has no lens; `sensor_error`:
    standard errors of the sensor's numbers, for a comment; `star_brightness`: the file of measured star brightness.
    """
    solution = matches.solution
    camera = solution.camera
    sensor_lines: list[str] = []
    if sensor is not None:
        sensor_lines = [
            *_errors_comment(sensor_error or {}),
            "[sensor]",
            *(f"{key} = {toml_value(value)}" for key, value in _flat_keys(sensor).items()),
        ]
        if star_brightness is not None:
            sensor_lines.append(f"star_brightness = {toml_value(star_brightness)}")
        sensor_lines.append("")
    lines = [
        *(f"# {line}" for line in head),
        "",
        *sensor_lines,
        "# The camera fitted to the stars."
        if camera.lens is not None
        else f"# The pinhole fitted to the stars, with a radial distortion (OpenCV's k1) of {solution.k1:.4f}.",
        *_errors_comment(matches.standard_error),
        *(["# Left and right are exchanged on the image."] if solution.mirrored else []),
        "[camera]",
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
        *(f"{key} = {toml_value(round(getattr(camera, key), 4))}" for key in ("fx_px", "fy_px", "cx_px", "cy_px")),
        f"skew_px = {toml_value(camera.skew_px)}",
        *(f"{key} = {toml_value(value)}" for key, value in ({} if camera.lens is None else camera.lens.keys).items()),
        *_other_tables(sensor),
        *([] if matches.readout is None else matches.readout.toml_lines()),
    ]
    return "\n".join(lines) + "\n"


def _errors_comment(standard_error: dict[str, float]) -> list[str]:
    errors = ", ".join(f"{key} {error:.2g}" for key, error in standard_error.items())
    return [f"# Standard errors: {errors}."] if errors else []


@dataclass(frozen=True, slots=True, eq=False)
class SharedGeometry:
    """The camera that several photographs share, and the attitude of each."""

    parts: tuple[GeometryCalibration, ...]  # One per photograph, all with the same camera
    shared_lens: SharedLensFit
    notes: tuple[Note, ...]  # Remarks for the user

    @property
    def best(self) -> GeometryCalibration:
        """The part with the most stars."""
        return max(self.parts, key=lambda part: len(part.matches))

    def to_toml(self) -> str:
        """Return the camera as TOML, for ``--config``."""
        names = ", ".join(part.image.path.name for part in self.parts)
        head = [
            f"Camera by glstar {__version__} from {len(self.parts)} images ({names}):"
            f" {sum(len(part.matches) for part in self.parts)} stars identified.  Geometry only: no sensor.",
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, None, self.best.matches)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values; ``images`` holds those of each part."""
        return {
            "schema": 2,
            "glstar": __version__,
            "sensor": None,
            "notes": [note.text for note in self.notes],
            "shared_lens": self.shared_lens.to_json([part.image.path.name for part in self.parts]),
            "images": [part.to_json() for part in self.parts],
        }


def share_geometry(parts: tuple[GeometryCalibration, ...], shared_lens: SharedLensFit) -> SharedGeometry:
    """Return the camera that several photographs share.

    `parts` have the matches of `shared_lens`.  Each of their notes is in the result once, with the names of its images.
    """
    names: dict[Note, list[str]] = {}
    for part in parts:
        for note in part.notes:
            names.setdefault(note, []).append(part.image.path.name)
    notes = (
        note if len(images) == len(parts) else replace(note, text=f"{', '.join(images)}: {note}")
        for note, images in names.items()
    )
    return SharedGeometry(parts, shared_lens, (Note(NoteKind.CAMERA, shared_lens.summary), *notes))
