"""The model of one photograph: sensor, sky, noise, shape, colour and hot pixels, as far as the image supports them."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import erf

from glstar import __version__
from glstar.arrays import Float, Index, Mask
from glstar.calibrate.geometry.camera import calibration_toml
from glstar.calibrate.identify.platesolution import sidereal_trails
from glstar.calibrate.notes import MODEL_NOTES, notes_without
from glstar.calibrate.photo.sky import NoiseAgainstLevel, SkyMap, measure_noise, measure_sky
from glstar.calibrate.sensor.brightness import BrightnessTerms, fit_brightness_terms, recorded_brightness
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.combine import StarTable
from glstar.calibrate.sensor.jointpsf import JointPsf, StarStamps, cut_stamps, fit_joint_psf, measure_fluxes
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import PointSpread
from glstar.camera.sensor.sensor import EffectValue, ElectronModel, Sensor
from glstar.camera.vignetting import relative_solid_angle
from glstar.errors import CalibrationError
from glstar.render.scene.starcomponents import colours_used
from glstar.sky.photometry import USUAL_BV, star_colours

# A hot pixel exceeds the sky by this, standard deviations: noise does so in one of 10^15 pixels.
_HOT_PIXEL_BRIGHT = 8.0
# Its four neighbours have less light than beside the narrowest star by this, standard deviations.
_HOT_PIXEL_NEIGHBOURS_DARK = 4.0
_NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class HotPixels:
    """Single bright pixels; in one photograph, tracks of particles across one pixel look the same."""

    x_px: Index  # (n,) intp: columns and rows
    y_px: Index
    excess_dn: Float  # (n,) above the sky; a saturated pixel has at least that

    def __len__(self) -> int:
        return len(self.x_px)

    def dark_frame_dn(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return a map (rows, columns) for ``dark_frame``: the excess at the hot pixels and 0 elsewhere, DN."""
        frame = np.zeros(shape, np.float32)
        frame[self.y_px, self.x_px] = self.excess_dn
        return frame


def find_hot_pixels(above_dn: Float, variance_dn2: Float, dn_per_e: float, joint: JointPsf) -> HotPixels:
    """Return the single bright pixels that are narrower than any star.

    `above_dn` (height, width): the image above its sky, DN; `variance_dn2` (height, width): of the sky and the sensor,
    DN^2; `dn_per_e`: variance of further light over its level, DN; 0 for the paper's noise; `joint`: shape of the
    stars.  Pixels at the edge are left out.  A star's light in the four neighbours of its brightest pixel, over that
    pixel, is least where the star is centred on the pixel.  Beside a hot pixel there is less than that, beyond the
    noise of all five pixels.  Stars much narrower than a pixel, sigma below 0.3 px, look like hot pixels, and none is
    found among them.
    """
    least = light_beside_star(joint)
    beside = cv2.filter2D(above_dn, -1, _NEIGHBOURS, borderType=cv2.BORDER_REFLECT)
    noise2 = variance_dn2 + dn_per_e * np.maximum(above_dn, 0)
    beside_noise2 = 4 * variance_dn2 + dn_per_e * np.maximum(beside, 0)
    missing = least * above_dn - beside
    hot = (above_dn > _HOT_PIXEL_BRIGHT * np.sqrt(variance_dn2)) & (
        missing > _HOT_PIXEL_NEIGHBOURS_DARK * np.sqrt(beside_noise2 + least**2 * noise2)
    )
    # Half of a star's light is missing at least: the profile of stars is not known better.
    hot &= missing > least * above_dn / 2
    hot[[0, -1]] = False
    hot[:, [0, -1]] = False
    y_px, x_px = np.nonzero(hot)
    return HotPixels(x_px, y_px, above_dn[hot])


def light_beside_star(joint: JointPsf) -> float:
    """Return the light in the four neighbours of a pixel over the pixel's, for the narrowest star, centred on it."""
    centre = beside = 0.0
    for one in replace(joint.psf, psf_ellipticity=0.0).components(joint.sigma_px, scale=joint.psf.scale_range[0]):
        scale = 1 / (np.sqrt(2) * one.sigma_px)
        middle = erf(0.5 * scale)
        next_to_it = (erf(1.5 * scale) - middle) / 2
        centre += one.flux_fraction * middle**2
        beside += 4 * one.flux_fraction * middle * next_to_it
    return float(beside / centre)


# The shape is measured on at most this number of stars, the brightest, of this signal-to-noise ratio, and at least on
# this number.
_MOST_SHAPED = 90
_SHAPED_SNR = 15.0
_LEAST_SHAPED = 6
# Sidereal trails are tried if the longest is longer than this, px.
_TRAIL_PX = 0.4
# A star of the catalogue without a detection within this distance was not detected, px.
_UNDETECTED_PX = 3.0
# Half the side of the stamps of stars, px and sigma.
_HALF_PX = 9
_HALF_SIGMA = 6.0
# Pixels above this fraction of the largest number, and their neighbours, are not used.
_FULL = 0.95
# Fluxes above this signal-to-noise ratio decide the zero point.
_ZERO_SNR = 10.0
_LEAST_ZERO = 3
# The sky has a map if its level differs by more than this, noises of a pixel or standard errors of a texel.
_UNEVEN_NOISE = 0.1
_UNEVEN_ERRORS = 3.0
# The full well lies above the converter's range by this factor: one image does not show it.
_WELL_ABOVE_RANGE = 1.05


@dataclass(frozen=True, slots=True, eq=False)
class PhotographModel:
    """What one photograph says of its camera and its sky."""

    calibration: Calibration  # With the sensor that these measurements give
    sky: SkyMap
    noise: NoiseAgainstLevel | None
    joint: JointPsf
    terms: BrightnessTerms
    hot: HotPixels
    brightness: StarTable  # Of each star, as the photograph records it
    has_map: bool  # Whether the sky is uneven, so that the sensor needs the map
    moved: bool  # Whether the camera was at rest on the ground and the sky moved: the stars have sidereal trails
    flux_dn: Float  # (n,) of the matched stars; NaN at the edge
    standard_error: dict[str, float]  # Of the keys of the sensor, by key
    refused: tuple[str, ...]  # What the image does not support, with numbers

    @property
    def sky_texels(self) -> NDArray[np.float32]:
        """The map of the sky's light, (rows, columns) float32, DN above the black level, for ``sky_map``."""
        electrons = self.calibration.sensor.electrons
        black_dn = 0.0 if electrons is None else electrons.black_level_dn
        texels = np.maximum(self.sky.texels_dn - black_dn, 0.0).astype(np.float32)
        return self._unmirrored(texels)

    @property
    def dark_frame(self) -> NDArray[np.float32] | None:
        """The hot pixels, (height, width) float32, DN, for ``dark_frame``; None without any, and for paper noise."""
        if self.calibration.sensor.electrons is None or not len(self.hot):
            return None
        return self._unmirrored(self.hot.dark_frame_dn(self.sky.level_dn.shape))

    def _unmirrored(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        # The simulator draws no mirror images.
        return np.ascontiguousarray(pixels[:, ::-1]) if self.calibration.matches.solution.mirrored else pixels

    def to_toml(self, sky_map: str, dark_frame: str, star_brightness: str) -> str:
        """Return the model as TOML, for ``--config``.

        `sky_map`: path of the map of the sky, beside the TOML file; `dark_frame`: path of the map of the hot pixels;
        `star_brightness`: path of the table of the stars' brightness.
        """
        calibration = self.calibration
        head = [
            f"Calibrated by glstar {__version__} from {calibration.image.path.name}: shape of {self.joint.stars} stars,"
            f" brightness of {self.terms.stars}.",
            *(f"{note}." for note in calibration.matches.notes),
            *(f"Not measured: {reason}." for reason in self.refused),
        ]
        effects = dict(calibration.sensor.effects) | ({"sensor.sky_map": sky_map} if self.has_map else {})
        effects |= {"sensor.dark_frame": dark_frame} if self.dark_frame is not None else {}
        sensor = replace(calibration.sensor, effects=effects)
        return calibration_toml(
            head,
            sensor,
            calibration.matches,
            sensor_error=self.standard_error,
            star_brightness=star_brightness if len(self.brightness) else None,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the measurements as JSON-serialisable values."""
        noise, slope = self.noise, self.terms.magnitude_slope
        return {
            "standard_error": self.standard_error,
            "psf_stars": self.joint.stars,
            "psf_misfit": self.joint.misfit,
            "brightness_scatter_mag": self.terms.scatter_mag,
            "brightness_stars": self.terms.stars,
            "noise_against_level": None if noise is None else {
                "level_dn": noise.level_dn.tolist(),
                "std_dn": np.sqrt(noise.variance_dn2).tolist(),
            },
            "response_exponent": None if slope is None else [1 + slope.value, slope.standard_error],
            "hot_pixels": np.column_stack([self.hot.x_px, self.hot.y_px, self.hot.excess_dn]).tolist(),
            "refused": list(self.refused),
        }  # fmt: skip


def measure_photograph(calibration: Calibration) -> PhotographModel:
    """Measure all that one photograph says of its sensor, its lens and its sky.

    Raises CalibrationError if there are too few stars or too little sky.
    """
    sky = measure_sky(calibration.image, calibration.detected, calibration.matches.predicted_xy_px)
    noise = measure_noise(sky)
    joint, moved = _shape(calibration, sky, noise)
    flux, error, used = _matched_fluxes(calibration, sky, noise, joint, moved=moved)
    stars = calibration.stars
    matched = calibration.matches.star
    terms = fit_brightness_terms(
        flux, error, stars.vmag, star_colours(calibration.reference.stars, matched),
        np.linalg.norm(_offset(calibration, stars.xy_px), axis=1), used,
    )  # fmt: skip
    hot = find_hot_pixels(sky.residual_dn, _pixel_variance(calibration, sky, noise), _gain(noise), joint)
    uneven_dn = float(np.std(sky.level_dn))
    limit = max(_UNEVEN_NOISE * calibration.sensor.sky_std_dn, _UNEVEN_ERRORS * sky.error_dn)
    has_map = uneven_dn > limit
    sensor, errors, refused = _sensor(calibration, sky, noise, joint, terms, has_map=has_map)
    refused = (*joint.refused, *refused)
    if not has_map:
        refused = (*refused, f"the sky is even: its level differs by {uneven_dn:.2g} DN (limit {limit:.2g})")
    if sensor.electrons is None and len(hot):
        refused = (*refused, f"{len(hot)} hot pixels are not simulated: they need noise that grows with the level")
    return PhotographModel(
        calibration=replace(calibration, sensor=sensor, notes=notes_without(calibration.notes, MODEL_NOTES)),
        sky=sky,
        noise=noise,
        joint=joint,
        terms=terms,
        hot=hot,
        brightness=recorded_brightness(calibration, terms, sensor.colour, flux, error),
        has_map=has_map,
        moved=moved,
        flux_dn=flux,
        standard_error=errors,
        refused=refused,
    )


def _offset(calibration: Calibration, xy_px: Float) -> Float:
    """Return positions in the frame of the simulator minus the principal point, over half the diagonal."""
    camera, mirrored = calibration.matches.solution.camera, calibration.matches.solution.mirrored
    x = camera.width_px - 1 - xy_px[:, 0] if mirrored else xy_px[:, 0]
    offset_px = np.column_stack([x, xy_px[:, 1]]) - np.array([camera.cx_px, camera.cy_px])
    return np.asarray(offset_px / (np.hypot(camera.width_px, camera.height_px) / 2))


def _detected_colours(calibration: Calibration) -> Float:
    """Return the colours B - V of the detected stars, (n,); the usual one of those that are not identified."""
    bv = np.full(len(calibration.detected), USUAL_BV)
    bv[calibration.matches.detection] = colours_used(calibration.reference.stars, calibration.matches.star)
    return bv


def _pixel_variance(calibration: Calibration, sky: SkyMap, noise: NoiseAgainstLevel | None) -> Float:
    if noise is None or not noise.is_shot_noise:
        return np.full(sky.level_dn.shape, calibration.sensor.sky_std_dn**2 + 1 / 12)
    return np.asarray(noise.variance_at_dn2(sky.level_dn) + 1 / 12)


def _gain(noise: NoiseAgainstLevel | None) -> float:
    """Return the gain, DN/e; 0 if the noise does not show it."""
    return noise.dn_per_e if noise is not None and noise.is_shot_noise else 0.0


def _stamps(
    calibration: Calibration, sky: SkyMap, noise: NoiseAgainstLevel | None, xy_px: Float, bv: Float, *, moved: bool
) -> tuple[StarStamps, Index]:
    image, detected = calibration.image, calibration.detected
    full = (image.pixels_dn >= _FULL * image.saturation_dn).astype(np.uint8)
    usable = cv2.dilate(full, np.ones((3, 3), np.uint8)) == 0
    trail_px = np.zeros_like(xy_px)
    if moved:
        trail_px = sidereal_trails(calibration.matches.solution, xy_px, calibration.sensor.reference_exposure_s)
    longest_px = float(np.linalg.norm(trail_px, axis=1).max(initial=0.0))
    half_px = int(np.ceil(max(_HALF_PX, _HALF_SIGMA * detected.psf_sigma_px) + longest_px / 2))
    variance = _pixel_variance(calibration, sky, noise)
    offset = _offset(calibration, xy_px)
    # Stars of the catalogue that were not detected have light, too.
    predicted_px = calibration.matches.predicted_xy_px
    undetected_px = predicted_px[KDTree(detected.xy_px).query(predicted_px)[0] > _UNDETECTED_PX]
    others_px = np.concatenate([detected.xy_px, undetected_px])
    return cut_stamps(
        above_dn=sky.residual_dn,
        variance_dn2=variance,
        usable=usable,
        xy_px=xy_px,
        others_px=others_px,
        trail_px=trail_px,
        offset=offset,
        bv=bv,
        half_px=half_px,
        dn_per_e=_gain(noise),
    )


def _shape(calibration: Calibration, sky: SkyMap, noise: NoiseAgainstLevel | None) -> tuple[JointPsf, bool]:
    """Return the shape of the stars, and whether the sky moved over the image."""
    detected = calibration.detected
    start_px = max(detected.psf_sigma_px, 0.5)
    clear = np.flatnonzero(~detected.saturated & (detected.signal_to_noise > _SHAPED_SNR))
    clear = clear[np.argsort(-detected.signal_to_noise[clear], kind="stable")][:_MOST_SHAPED]
    bv = _detected_colours(calibration)
    stamps, inside = _stamps(calibration, sky, noise, detected.xy_px[clear], bv[clear], moved=False)
    if len(stamps) < _LEAST_SHAPED:
        raise CalibrationError(
            f"the shape of the stars needs {_LEAST_SHAPED} stars of a signal-to-noise ratio of {_SHAPED_SNR:g} that are"
            f" not saturated, and the image has {len(stamps)}",
            stars_used=len(stamps),
            stars_needed=_LEAST_SHAPED,
        )
    chosen = clear[inside]
    fits = []
    for moved in (False, True):
        stamps, _ = _stamps(calibration, sky, noise, detected.xy_px[chosen], bv[chosen], moved=moved)
        longest_px = float(np.linalg.norm(stamps.trail_px, axis=1).max(initial=0.0))
        if not moved or longest_px > _TRAIL_PX:
            fits.append((fit_joint_psf(stamps, start_px)[0], moved))
    return min(fits, key=lambda one: one[0].misfit)


def _matched_fluxes(
    calibration: Calibration, sky: SkyMap, noise: NoiseAgainstLevel | None, joint: JointPsf, *, moved: bool
) -> tuple[Float, Float, Mask]:
    """Return fluxes and errors of the matched stars, and which of them are good for the zero point."""
    stars = calibration.stars
    bv = colours_used(calibration.reference.stars, calibration.matches.star)
    stamps, inside = _stamps(calibration, sky, noise, stars.xy_px, bv, moved=moved)
    flux, error = np.full(len(stars), np.nan), np.full(len(stars), np.inf)
    flux[inside], error[inside], _ = measure_fluxes(stamps, joint)
    flux = np.where(flux > 0, flux, np.nan)
    good = np.isfinite(flux) & (np.nan_to_num(flux) > _ZERO_SNR * error) & ~stars.blended
    # Saturated stars are known by their wings only.
    lone = good & ~stars.saturated
    used = lone if lone.sum() >= 2 * _LEAST_ZERO + 4 else good
    if used.sum() < _LEAST_ZERO:
        raise CalibrationError(
            f"the zero point needs {_LEAST_ZERO} identified stars of a signal-to-noise ratio of {_ZERO_SNR:g}, and the"
            f" image has {int(used.sum())}",
            stars_used=int(used.sum()),
            stars_needed=_LEAST_ZERO,
        )
    return np.nan_to_num(flux), error, used


def _sensor(
    calibration: Calibration,
    sky: SkyMap,
    noise: NoiseAgainstLevel | None,
    joint: JointPsf,
    terms: BrightnessTerms,
    *,
    has_map: bool,
) -> tuple[Sensor, dict[str, float], tuple[str, ...]]:
    """Return the sensor, the standard errors of its keys, and what was refused."""
    old, refused = calibration.sensor, []
    exposure_s = old.reference_exposure_s
    effects: dict[str, EffectValue] = {
        f"sensor.{key}": value for key, value in _unmirrored_psf(calibration, joint).keys.items()
    }
    effects |= calibration.image.output_keys
    errors = dict(joint.standard_error)
    if terms.colour is not None:
        effects |= {"sensor.band": "custom", "sensor.band_slope": round(terms.colour.value, 4)}
        errors["band_slope"] = terms.colour.standard_error
        if terms.curvature is not None:
            effects |= {"sensor.band_curvature": round(terms.curvature.value, 4)}
            errors["band_curvature"] = terms.curvature.standard_error
    else:
        refused.append("the stars do not show a colour term: brightness follows V")
    if terms.loss_mag is not None:
        farthest = float(np.linalg.norm(_offset(calibration, calibration.stars.xy_px), axis=1).max())
        effects |= _vignetting(calibration.matches.solution.camera, terms.loss_mag.value, farthest)
        errors["vignetting_r2"] = 0.92 * terms.loss_mag.standard_error
    else:
        refused.append("the stars do not show vignetting")
    mean_dn = float(sky.texels_dn.mean())
    electrons = None
    if noise is not None and noise.is_shot_noise:
        electrons = _electrons(noise, sky, terms, exposure_s, old.saturation_dn)
        errors["gain_dn_per_e"] = noise.dn_per_e_error
        errors["vmag_0_e_per_s"] = electrons.vmag_0_e_per_s * float(
            np.hypot(0.921 * terms.zero_error_mag, noise.dn_per_e_error / noise.dn_per_e)
        )
    elif noise is not None:
        refused.append(
            f"the noise does not grow with the level of the sky ({noise.dn_per_e:.3g} ± {noise.dn_per_e_error:.2g}"
            " DN/e): one standard deviation for all pixels"
        )
    flux_dn = float(10 ** (-0.4 * (terms.zero_mag + old.reference_vmag)))
    peak_dn = flux_dn / joint.psf.flux_per_peak_px2(joint.sigma_px)
    if electrons is None:
        errors["reference_peak_dn"] = 0.921 * peak_dn * terms.zero_error_mag
    sensor = replace(
        old,
        psf_sigma_px=joint.sigma_px,
        reference_peak_dn=peak_dn,
        sky_mean_dn=max(mean_dn, 0.0) if has_map else old.sky_mean_dn,
        electrons=electrons,
        effects=effects,
    )
    return sensor, errors, tuple(refused)


def _unmirrored_psf(calibration: Calibration, joint: JointPsf) -> PointSpread:
    """Return the point spread function in the frame of the simulator, which draws no mirror images."""
    if not calibration.matches.solution.mirrored or not joint.psf.psf_ellipticity:
        return joint.psf
    return replace(joint.psf, psf_angle_rad=np.pi - joint.psf.psf_angle_rad)


def _electrons(
    noise: NoiseAgainstLevel, sky: SkyMap, terms: BrightnessTerms, exposure_s: float, saturation_dn: int
) -> ElectronModel:
    """Return the electron model: the noise's line, with the smallest black level that it allows.

    One image shows the variance at each level and not how it divides into black level and read noise.
    """
    gain = noise.dn_per_e
    black_dn = min(max(-noise.at_zero_dn2 / gain, 0.0), max(float(sky.texels_dn.min()), 0.0))
    read_dn2 = max(noise.at_zero_dn2 + gain * black_dn, 0.0)
    sky_e = max(float(sky.texels_dn.mean()) - black_dn, 0.0) / gain
    return ElectronModel(
        vmag_0_e_per_s=float(10 ** (-0.4 * terms.zero_mag)) / gain / exposure_s,
        sky_e_per_s=sky_e / exposure_s,
        gain_dn_per_e=gain,
        analogue_gain=1.0,
        full_well_e=_WELL_ABOVE_RANGE * (saturation_dn - black_dn) / gain,
        black_level_dn=black_dn,
        read_noise_before_gain_e=float(np.sqrt(read_dn2)) / gain,
        read_noise_after_gain_e=0.0,
        dark_current_e_per_s=0.0,
    )


# Weight of the vignetting where no star is.
_BEYOND_STARS = 0.05


def _vignetting(camera: Camera, loss_mag: float, farthest: float) -> dict[str, EffectValue]:
    """Return the keys of ``[lens]`` with which stars lose this at half the diagonal.

    `farthest`: the largest distance of a star from the principal point, over half the diagonal; farther out, where a
    lens that sees the whole sky has nothing, the polynomial is only roughly right.
    """
    r = np.linspace(0, 1, 41)
    half_px = np.hypot(camera.width_px, camera.height_px) / 2
    # Along the half diagonal that stays on the image.
    towards = np.array([camera.width_px / 2 - camera.cx_px, camera.height_px / 2 - camera.cy_px])
    diagonal = np.array([camera.width_px, camera.height_px]) / (2 * half_px)
    diagonal = diagonal * np.where(towards < 0, -1.0, 1.0)
    xy_px = np.array([camera.cx_px, camera.cy_px]) + half_px * r[:, np.newaxis] * diagonal
    sky = 10 ** (-0.4 * loss_mag * r**2) * relative_solid_angle(camera, xy_px)
    seen = np.isfinite(sky) & (sky > 0)
    powers = np.column_stack([r[seen] ** 2, r[seen] ** 4, r[seen] ** 6])
    weight = np.where(r[seen] <= farthest, 1.0, _BEYOND_STARS)
    v2, v4, v6 = np.linalg.lstsq(powers * weight[:, np.newaxis], (sky[seen] - 1) * weight, rcond=None)[0].tolist()
    return {
        "lens.vignetting": "polynomial",
        "lens.vignetting_r2": round(v2, 5),
        "lens.vignetting_r4": round(v4, 5),
        "lens.vignetting_r6": round(v6, 5),
    }
