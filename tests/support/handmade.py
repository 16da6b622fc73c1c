"""Calibrations made by hand: stars with given numbers, without an image that was measured."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.photo.detection import Background, DetectedStars, SkyLevel
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.sky import NoiseAgainstLevel, SkyMap
from glstar.calibrate.sensor.brightness import BrightnessTerms
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.fit import BrightnessFit, MeasuredStars, fit_brightness
from glstar.calibrate.sensor.jointpsf import JointPsf, StarStamps
from glstar.calibrate.sensor.misfit import Measurement, Misfit
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import PointSpread
from glstar.camera.sensor.sensor import Sensor
from glstar.rotation import about_x, about_y
from glstar.sky.catalogue.starfield import StarField

CAMERA = Camera(400, 300, 500.0, 490.0, 210.0, 140.0)
# The optical axis lies 40 deg above the horizon, in the direction of y; the zenith is that of the coordinates.
C_CAMERA_EQ = about_x(np.deg2rad(-50.0)) @ about_y(0.0)
NOTHING = Measurement(0.0, 1e-3)
PLAIN = Misfit(
    wing_fraction=NOTHING,
    stacked=None,
    corner_loss_mag=NOTHING,
    mean_loss_mag=0.25,
    brightness_map_mag=np.full((3, 4), np.nan),
    gradient_dn=NOTHING,
    gradient_towards_rad=0.0,
    rest_dn=1.5,
    rest_without_bowl_dn=0.5,
    ellipticity=NOTHING,
    long_axis_rad=0.5,
    corner_growth=NOTHING,
    neighbour_correlation=NOTHING,
    lattice_excess=NOTHING,
)


def handmade(
    off_mag: np.ndarray,
    *,
    name: str = "a.png",
    exposure_s: float = 0.5,
    peak_dn: float = 900.0,
    noise_dn: float = 4.0,
    first: int = 0,
    bits: int = 12,
) -> Calibration:
    """Return a calibration of stars that are fainter than V says by some magnitudes, one each.

    A star of V 4 has the peak `peak_dn` in half a second; `first` is the number of the first star.
    """
    count = len(off_mag)
    rng = np.random.default_rng(17)
    numbers = np.arange(first, first + count)
    # The same stars have the same numbers, places and magnitudes on all images.
    places = rng.uniform(5, [394, 294], (200, 2))[numbers]
    vmag = np.round(rng.uniform(2.5, 5.5, 200), 2)[numbers]
    bv = np.round(rng.uniform(-0.2, 1.6, 200), 2)[numbers]
    amplitude = peak_dn * exposure_s / 0.5 * 10 ** (-0.4 * (vmag - 4.0 + off_mag))
    names = tuple(f"S{number}" for number in numbers)
    field = StarField(
        "bsc5",
        (1000 + numbers).astype(np.int32),
        names,
        vmag,
        CAMERA.unit_vectors(places) @ C_CAMERA_EQ,
        0.0,
        np.eye(3),
        bv=bv,
    )
    reference = ReferenceStars(field, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0, np.diag([1.0, -1.0, -1.0]))
    row = np.arange(count)
    matches = Matches(
        solution=PlateSolution(CAMERA, C_CAMERA_EQ),
        star=row,
        detection=row,
        residual_px=np.column_stack([0.01 * row, -0.02 * row]),
        predicted=row,
        predicted_xy_px=places,
        chance=1e-20,
    )
    level = np.full((300, 400), 50.0)
    flags = np.zeros(count, bool)
    noise = np.full(count, noise_dn)
    width_px = 1.3 + 0.002 * row
    detected = DetectedStars(
        xy_px=places,
        peak_dn=amplitude,
        sigma_px=width_px,
        noise_dn=noise,
        saturated=flags,
        psf_sigma_px=1.35,
        background=Background(level, np.full(level.shape, 4.0), level > 0, level > 0),
        sky=SkyLevel(50.0, 4.0, 0.7, 100000, 0.125),
        drawn_out_px=0.0,
        saturated_fraction=0.0,
        hot_pixels=2,
        at_the_edge=3,
        shapeless=4,
    )
    stars = MeasuredStars(
        catalogue="bsc5",
        star_id=field.star_id,
        name=names,
        vmag=vmag,
        xy_px=places,
        residual_px=matches.residual_px,
        peak_dn=amplitude,
        sigma_px=width_px,
        noise_dn=noise,
        saturated=flags.copy(),
        blended=flags.copy(),
        psf_sigma_error_px=0.02,
        trail_px=np.zeros((count, 2)),
    )
    brightness = fit_brightness(vmag, amplitude, np.ones(count, bool))
    sensor = Sensor(
        reference_vmag=brightness.reference_vmag,
        reference_peak_dn=brightness.reference_peak_dn,
        reference_exposure_s=exposure_s,
        psf_sigma_px=1.35,
        sky_mean_dn=50.0,
        sky_std_dn=4.0,
        bit_depth=bits,
    )
    image = Photograph(Path(name), level.copy(), bits, "grey", None)
    return Calibration(image, detected, reference, matches, sensor, brightness, stars, "by hand", (), PLAIN)


def with_stars(calibration: Calibration, **given: object) -> Calibration:
    """Return a calibration whose stars have other measurements."""
    return replace(calibration, stars=replace(calibration.stars, **given))


# Parts of the model of a photograph.
OFF = np.random.default_rng(3).normal(0, 0.1, 30)
JOINT = JointPsf(
    PointSpread(psf_wing_fraction=0.1, psf_wing_sigma_px=4.0), 1.2, {"psf_sigma_px": 0.01}, 25, 1.1, ("no growth",)
)
TERMS = BrightnessTerms(
    zero_mag=-11.0,
    zero_error_mag=0.02,
    colour=Measurement(-0.31234, 0.02),
    curvature=Measurement(0.12345, 0.03),
    loss_mag=Measurement(0.4, 0.05),
    magnitude_slope=Measurement(0.01, 0.004),
    scatter_mag=0.07,
    stars=28,
    residual_mag=np.zeros(30),
)
NOISE = NoiseAgainstLevel(
    np.array([40.0, 60.0]),
    np.array([13.0, 19.0]),
    np.array([0.5, 0.6]),
    dn_per_e=0.3,
    dn_per_e_error=0.06,
    at_zero_dn2=1.5,
)


def sky_of(level_dn: float = 50.0, slope: float = 0.0) -> SkyMap:
    """Return a sky that brightens to the right."""
    level = level_dn + slope * (np.arange(400) - 199.5)[np.newaxis] + np.zeros((300, 1))
    texels = np.array([[level_dn - 6.0, level_dn + 2.0], [level_dn, level_dn + 4.0]])
    return SkyMap(texels, level, np.zeros((300, 400)), np.ones((300, 400), bool), 0.05)


def stamps_of(count: int = 3, side: int = 13, seed: int = 1, trail: bool = False, **given: object) -> StarStamps:
    """Return stamps of stars near their middles, without light."""
    rng = np.random.default_rng(seed)
    corner = rng.integers(5, 90, (count, 2)).astype(float)
    fields = {
        "corner_px": corner,
        "values_dn": np.zeros((count, side, side)),
        "variance_dn2": rng.uniform(4, 9, (count, side, side)),
        "xy_px": corner + side // 2 + rng.uniform(-0.5, 0.5, (count, 2)),
        "trail_px": rng.uniform(-2, 2, (count, 2)) if trail else np.zeros((count, 2)),
        "offset": rng.uniform(-0.7, 0.7, (count, 2)),
        "bv": rng.uniform(-0.2, 1.5, count),
        "dn_per_e": 0.3,
    }
    return StarStamps(**fields | given)


class Stars(SimpleNamespace):
    """The part of `MeasuredStars` that a measurement uses."""

    def __len__(self) -> int:
        return len(self.xy_px)


def picture(pixels: np.ndarray) -> Photograph:
    """Return a grey photograph of 12 bits."""
    return Photograph(Path("a.png"), pixels, 12, "grey", None)


def law(used: np.ndarray) -> BrightnessFit:
    """Return a law of brightness that used some stars."""
    return BrightnessFit("median", 4.0, 800.0, used, 0.1, 0.01, -0.4, -0.42, -0.38)
