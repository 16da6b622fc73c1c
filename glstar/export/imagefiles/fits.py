"""16-bit FITS files with a header on exposure, sensor, site and world coordinates.

World coordinates are a zenithal projection with polynomial distortion (SIP): the tangent plane (TAN), or for a wide
lens its own projection as a polynomial of the angle from the axis (ZPN). The fit relates pixels to astrometric
directions: ICRS at the epoch of the image, as a catalogue gives them after proper motion and parallax. It contains the
lens, refraction, annual and diurnal aberration, precession and nutation.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import degrees
from typing import Any

import erfa
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import Pointing
from glstar.render.scene.scene import Frame, Scene
from glstar.sky.place.timescale import format_utc

# The polynomial has the lowest order whose largest error is below this, px; SIP allows orders up to 9.
_SUFFICIENT_PX = 0.002
_ORDERS = range(2, 10)
# Nodes per side of the fit (Chebyshev, so that errors at the border stay as small as inside) and of its validation.
_FIT_NODES = 28
_VALIDATION_NODES = 23
# The fit extends beyond the image by this fraction of its sides.
_MARGIN = 0.01
# Newton steps from a pixel to the direction that refraction moves there; each gains at least a factor of 3, on the
# horizon, and 1000 in the upper sky.
_REFRACTION_STEPS = 25
# Points that have not converged to this after the steps are left out, rad: 0.0002".
_CONVERGED_RAD = 1e-9


# Largest relative change of the polynomial's scale over the image at which it is inverted by iteration, as astropy's
# all_world2pix does; of a lens at which the tangent plane changes more, the projection is that of the lens.
_INVERTIBLE = 0.5
# Powers of the angle in that projection, ZPN.
_POWERS = np.arange(1, 20, 2)
# Points along each side of the image at which the scale is evaluated.
_SCALE_NODES = 9


@dataclass(frozen=True, eq=False)
class SipCoordinates:
    """World coordinates of an image, in the terms of the SIP convention."""

    # (k,) coefficients of the angle's `_POWERS` in the projection ZPN; empty for the tangent plane.
    radial: Float
    crpix_px: Float  # (2,) the reference pixel (x, y), counted from 0
    crval_rad: Float  # (2,) right ascension and declination (ICRS) of the reference pixel, rad
    cd_rad: Float  # (2, 2) matrix from pixels to the plane of the projection, rad/px
    # (order + 1, order + 1) coefficients of the forward and the inverse polynomial; ``a[i, j]`` belongs to u^i v^j.
    a: Float
    b: Float
    ap: Float
    bp: Float
    rms_px: float  # Error of the forward polynomial over the image above the horizon
    max_px: float
    inverse_max_px: float  # Largest error of the inverse polynomial

    @property
    def order(self) -> int:
        """The order of the polynomials."""
        return len(self.a) - 1


def fit_sip(scene: Scene) -> SipCoordinates | None:
    """Fit the world coordinates of an image in the middle of its exposure, or of each row's with a rolling shutter.

    None if too little of the image lies above the horizon to fit a polynomial. Shupe et al. 2005, *ASP Conf. Ser.* 347,
    491 (SIP); Calabretta & Greisen 2002, *A&A* 395, 1077 (TAN, ZPN).
    """
    sky = _SkyOfPixels(scene)
    nodes = _grid(scene, np.cos(np.pi * (np.arange(_FIT_NODES) + 0.5) / _FIT_NODES))
    tests = _grid(scene, np.linspace(-1, 1, _VALIDATION_NODES))
    nodes, plane = _above_horizon(nodes, sky.plane(nodes))
    tests, expected = _above_horizon(tests, sky.plane(tests))
    best: SipCoordinates | None = None
    for order in _ORDERS:
        if len(nodes) < 4 * len(_exponents(order)) or not len(tests):
            break
        fit = _fitted(order, nodes, plane, tests, expected, sky)
        if best is None or fit.max_px < best.max_px:
            best = fit
        if best.max_px < _SUFFICIENT_PX:
            break
    return best


def _radial_of(camera: Camera) -> Float:
    """Return `SipCoordinates.radial` of a camera: the tangent plane where the polynomial can be inverted."""
    lens = camera.lens
    if lens is None:
        return np.zeros(0)
    columns, rows = (np.linspace(-0.5, side - 0.5, _SCALE_NODES) for side in (camera.width_px, camera.height_px))
    seen = camera.unit_vectors(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    seen = seen[np.isfinite(seen).all(axis=1) & (seen[:, 2] < 1)]
    # Along the radius and at right angles to it; of the tangent plane 1 / cos^2 and 1 / cos.
    scale_px = np.linalg.norm(camera.px_per_rad(seen), axis=1)
    scale_px /= np.linalg.norm(camera.px_per_rad([0.0, 0.0, 1.0]), axis=0).mean()
    cosine = seen[:, 2:]
    if (cosine > 0).all() and np.abs(cosine ** [-2.0, -1.0] / scale_px - 1).max() < _INVERTIBLE:
        return np.zeros(0)
    # Up to just within the limit of the lens.
    farthest_rad = min((1 + 2 * _MARGIN) * camera.field_radius_rad, 0.9999 * camera.limit_rad)
    part = np.sin(np.linspace(0, np.pi / 2, 500))[1:]
    radius = lens.radius(part * farthest_rad) / lens.radius(1e-6) * 1e-6
    weight = 1 / part
    scaled, *_ = np.linalg.lstsq((part[:, np.newaxis] ** _POWERS) * weight[:, np.newaxis], radius * weight, rcond=None)
    return np.asarray(scaled / farthest_rad**_POWERS)


class _SkyOfPixels:
    """The astrometric directions of the pixels of one scene, and the plane of their projection."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.radial = _radial_of(scene.camera)
        # Earth's barycentric velocity in units of the speed of light, ICRS; the stars are of this epoch.
        utc_jd = 2440587.5 + scene.stars.epoch_utc_s / 86400
        _, barycentric = erfa.epv00(2400000.5, utc_jd - 2400000.5)
        self._velocity = np.asarray(barycentric["v"], dtype=np.float64) * erfa.DAU / erfa.DAYSEC / erfa.CMPS
        pole = self._icrs(self._unrefracted(np.array([[scene.camera.cx_px, scene.camera.cy_px]]), 0))[0]
        self.crval_rad = np.array([np.arctan2(pole[1], pole[0]) % (2 * np.pi), np.arcsin(np.clip(pole[2], -1, 1))])

    @cached_property
    def _axes(self) -> Float:
        """Unit vectors to the east, the north and the reference point, (3, 3)."""
        ra, dec = self.crval_rad
        return np.array(
            [
                [-np.sin(ra), np.cos(ra), 0.0],
                [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)],
                [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)],
            ]
        )

    def plane(self, xy_px: Float) -> Float:
        """Return projected coordinates (to the east, to the north) of pixels, (n, 2) rad; NaN for no sky."""
        east, north, ahead = (self._icrs(self._unrefracted(xy_px, _REFRACTION_STEPS)) @ self._axes.T).T
        if not self.radial.size:
            ahead = np.where(ahead > 0, ahead, np.nan)
            return np.column_stack([east / ahead, north / ahead])
        across = np.hypot(east, north)
        angle_rad = np.arctan2(across, ahead)[:, np.newaxis]
        scale = (angle_rad**_POWERS @ self.radial) / np.where(across > 0, across, 1.0)
        return np.column_stack([east * scale, north * scale])

    def _unrefracted(self, xy_px: Float, steps: int) -> Float:
        """Return the geocentric apparent directions whose stars are drawn at pixels, (n, 3); NaN below the horizon."""
        seen = self._scene.camera.unit_vectors(xy_px)
        observer = self._observer(xy_px)
        direction = observer.to_sky(seen)
        for _ in range(steps):
            direction = direction + observer.to_sky(seen - observer.drawn(direction, below_horizon=True))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        if steps:
            drawn = observer.drawn(direction, below_horizon=False)
            direction[~(np.abs(drawn - seen).max(axis=1) < _CONVERGED_RAD)] = np.nan
        return direction

    def _observer(self, xy_px: Float) -> "_Observer":
        """Return the camera in the middle of the exposure, or of each pixel's row with a rolling shutter."""
        scene, exposure = self._scene, self._scene.exposure
        if exposure.readout_s == 0 or scene.motion is None:
            return _Observer(scene.shutter[1:2])
        opening_s = exposure.opening_at_s(xy_px, scene.camera.width_px, scene.camera.height_px)
        utc_s = exposure.mid_utc_s + opening_s - exposure.readout_s / 2
        # The fit extends a little beyond the first and the last row.
        (pointing,) = scene.motion.pointings(utc_s.clip(exposure.start_utc_s, exposure.stop_utc_s))
        return _Observer(pointing)

    def _icrs(self, direction_eq: Float) -> Float:
        """Return astrometric directions, (n, 3): without annual aberration, in the axes of ICRS."""
        proper: Float = direction_eq @ self._scene.stars.C_eq_icrs
        # The inverse of relativistic aberration is the aberration of the opposite velocity.
        velocity = -self._velocity
        inverse_gamma = np.sqrt(1 - velocity @ velocity)
        along = proper @ velocity
        moved = inverse_gamma * proper + (1 + along / (1 + inverse_gamma))[:, np.newaxis] * velocity
        return np.asarray(moved / (1 + along)[:, np.newaxis])


@dataclass(frozen=True, eq=False)
class _Observer:
    """The camera at the time of n pixels: one for all of them, or one for each."""

    pointing: Pointing

    def to_sky(self, seen: Float) -> Float:
        """Return vectors of the camera's axes, (n, 3), in the axes of the true equator and equinox."""
        C = self.pointing.C_camera_eq
        return np.asarray(seen @ C[0] if len(C) == 1 else np.einsum("ni,nij->nj", seen, C))

    def drawn(self, direction_eq: Float, *, below_horizon: bool) -> Float:
        """Return the unit vectors of the camera's axes, (n, 3), along which stars of some directions are drawn."""
        pointing = self.pointing
        if len(pointing) == 1:
            drawn = pointing.to_camera(direction_eq, below_horizon=below_horizon)[0]
        else:
            drawn = pointing.each_to_camera(direction_eq, below_horizon=below_horizon)
        return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def _grid(scene: Scene, nodes: Float) -> Float:
    """Return pixels on the nodes (-1 to 1) along both sides of an image and a margin, (n, 2) px."""
    camera = scene.camera
    sides = np.array([camera.width_px, camera.height_px])
    columns, rows = ((side - 1) / 2 + (0.5 + _MARGIN) * side * nodes for side in sides)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _above_horizon(xy_px: Float, plane_rad: Float) -> tuple[Float, Float]:
    seen = np.isfinite(plane_rad).all(axis=1)
    return xy_px[seen], plane_rad[seen]


def _exponents(order: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]


def _terms(points: Float, exponents: list[tuple[int, int]]) -> Float:
    """Return the monomials of points, (n, terms)."""
    powers = points[:, :, np.newaxis] ** np.arange(max(map(sum, exponents)) + 1)
    return np.stack([powers[:, 0, i] * powers[:, 1, j] for i, j in exponents], axis=1)


def _fitted(order: int, nodes: Float, plane: Float, tests: Float, expected: Float, sky: _SkyOfPixels) -> SipCoordinates:
    """Fit polynomials of one order to pixels and projected coordinates, and measure their errors on others."""
    inverse = _Polynomial.fit(plane, nodes, _exponents(order))
    crpix_px = inverse(np.zeros((1, 2)))[0]
    without_constant = _exponents(order)[1:]
    forward = _Polynomial.fit(nodes - crpix_px, plane, without_constant)
    of = dict(zip(without_constant, forward.coefficients, strict=True))
    cd_rad = np.column_stack([of[1, 0], of[0, 1]])
    to_px = np.linalg.inv(cd_rad)
    a, b = _matrices(order, {key: to_px @ value for key, value in of.items() if sum(key) > 1})
    # From the linear estimate of the pixel offset to what the forward polynomial adds to it, inverted.
    linear, linear_tests = plane @ to_px.T, expected @ to_px.T
    back = _Polynomial.fit(linear, nodes - crpix_px - linear, _exponents(order))
    ap, bp = _matrices(order, dict(zip(_exponents(order), back.coefficients, strict=True)))
    # The error in the plane, in px by the forward polynomial's own local scale.
    wrong = forward(tests - crpix_px) - expected
    step = 0.5
    columns = [forward(tests + half - crpix_px) - forward(tests - half - crpix_px) for half in step * np.eye(2)]
    jacobian = np.stack(columns, axis=-1) / (2 * step)
    error_px = np.linalg.norm(np.linalg.solve(jacobian, wrong[..., np.newaxis])[..., 0], axis=1)
    inverse_px = np.linalg.norm(linear_tests + back(linear_tests) - (tests - crpix_px), axis=1)
    return SipCoordinates(
        radial=sky.radial,
        crpix_px=crpix_px,
        crval_rad=sky.crval_rad,
        cd_rad=cd_rad,
        a=a,
        b=b,
        ap=ap,
        bp=bp,
        rms_px=float(np.sqrt(np.mean(error_px**2))),
        max_px=float(error_px.max()),
        inverse_max_px=float(inverse_px.max()),
    )


@dataclass(frozen=True, eq=False)
class _Polynomial:
    """A polynomial of two variables with values in a plane."""

    exponents: list[tuple[int, int]]
    coefficients: Float  # (terms, 2)

    @classmethod
    def fit(cls, points: Float, values: Float, exponents: list[tuple[int, int]]) -> "_Polynomial":
        """Return the least-squares fit to values (n, 2) at points (n, 2), solved in points of unit size."""
        scale = np.abs(points).max()
        scaled, *_ = np.linalg.lstsq(_terms(points / scale, exponents), values, rcond=None)
        sizes = scale ** np.array([sum(one) for one in exponents], dtype=np.float64)
        return cls(exponents, scaled / sizes[:, np.newaxis])

    def __call__(self, points: Float) -> Float:
        return np.asarray(_terms(points, self.exponents) @ self.coefficients)


def _matrices(order: int, coefficients: dict[tuple[int, int], Float]) -> tuple[Float, Float]:
    """Return the coefficients of x and of y as matrices by exponent."""
    x, y = np.zeros((order + 1, order + 1)), np.zeros((order + 1, order + 1))
    for (i, j), (of_x, of_y) in coefficients.items():
        x[i, j], y[i, j] = of_x, of_y
    return x, y


_BLOCK = 2880
_CARD = 80
# Signed integers of a file are unsigned ones minus this.
_ZERO = 32768
# Longest header that is read, bytes: SIP of order 9 needs 19 kB.
FITS_START = 16 * _BLOCK

Value = str | float | int | bool
Card = tuple[str, Value, str]


def encode_fits(scene: Scene, frame: Frame, *, number: int, shift_bits: int = 0) -> bytes:
    """Return an image as a FITS file of 16 bits: one header and data unit.

    Row 0 of the image is the first row of the file. The stored numbers are shifted up by `shift_bits`; BSCALE and BZERO
    scale them back. The time of writing is left out, so that equal frames give equal bytes. FITS standard 4.0, sections
    3, 4.4.2.5 (BZERO) and 4.4.2.7 (checksums); SIP, Shupe et al. 2005.
    """
    rows, columns = frame.pixels.shape
    stored = ((frame.pixels.astype(np.int32) << shift_bits) - _ZERO).astype(">i2").tobytes()
    data = stored + bytes(-len(stored) % _BLOCK)
    cards: list[Card] = [
        ("SIMPLE", True, "FITS"),
        ("BITPIX", 16, "bits per value"),
        ("NAXIS", 2, ""),
        ("NAXIS1", columns, "px"),
        ("NAXIS2", rows, "px"),
        ("BZERO", _ZERO >> shift_bits, "unsigned integers"),
        ("BSCALE", 1 if not shift_bits else 2.0**-shift_bits, "" if not shift_bits else "numbers in the highest bits"),
        *_exposure_cards(scene, frame, number),
        *_sensor_cards(scene),
        *_wcs_cards(fit_sip(scene)),
        ("DATASUM", str(_ones_complement_sum(data)), "checksum of the data"),
        ("CHECKSUM", "0" * 16, "checksum of the whole file"),
    ]
    return _with_checksum(_header([_line(*card) for card in cards]), data)


def without_truth(content: bytes, utc: Mapping[str, str]) -> bytes:
    """Return a file of `encode_fits` for a navigator: without coordinates, site and seed, with the times of its clock.

    `utc` has the UTC at ``start``, ``middle`` and ``end`` of the exposure, as in ``nav.jsonl``.
    """
    header = _header_of(content)
    assert header is not None
    length, _ = header
    lines = [content[at : at + _CARD].decode("ascii").rstrip() for at in range(0, length, _CARD)]
    kept = [line for line in lines if line[:8].rstrip() in _KNOWN_TO_NAVIGATORS]
    stated = [
        _line(f"DATE-{keyword}", utc[instant].removesuffix("Z"), "UTC by the camera's clock")
        for keyword, instant in (("OBS", "start"), ("AVG", "middle"), ("END", "end"))
    ]
    checksums = [line for line in lines if line.startswith(("DATASUM ", "CHECKSUM="))]
    blank = [re.sub(r"^CHECKSUM= '.{16}'", f"CHECKSUM= '{'0' * 16}'", line) for line in checksums]
    return _with_checksum(_header([*kept, *stated, *blank]), content[length:])


_STRUCTURE = ("SIMPLE", "BITPIX", "NAXIS", "NAXIS1", "NAXIS2", "BZERO", "BSCALE", "ROWORDER")
_LENGTH = ("EXPTIME", "NCOMBINE", "SUBEXP", "SUBGAP")
_SETTINGS = ("SATURATE", "BUNIT", "GAIN", "DNPERE", "CCD-TEMP", "BLKLEVEL", "BAYERPAT")
_KNOWN_TO_NAVIGATORS = frozenset(("IMAGETYP", "FRAME", "SWCREATE", *_STRUCTURE, *_LENGTH, *_SETTINGS))


def _with_checksum(header: bytes, data: bytes) -> bytes:
    """Return a file whose header has its checksum in place of zeros."""
    code = _encoded_checksum(_ones_complement_sum(header + data))
    return header.replace(b"CHECKSUM= '0000000000000000'", f"CHECKSUM= '{code}'".encode()) + data


def _exposure_cards(scene: Scene, frame: Frame, number: int) -> Iterator[Card]:
    exposure, site = scene.exposure, scene.site
    yield "DATE-OBS", _time(exposure.start_utc_s), "UTC as the shutter opens"
    yield "DATE-AVG", _time(exposure.mid_utc_s), "UTC in the middle of the exposure"
    yield "DATE-END", _time(exposure.stop_utc_s), "UTC as the shutter closes"
    yield "MJD-OBS", _mjd(exposure.start_utc_s), "the same three times in days"
    yield "MJD-AVG", _mjd(exposure.mid_utc_s), ""
    yield "MJD-END", _mjd(exposure.stop_utc_s), ""
    yield "TIMESYS", "UTC", ""
    yield "CLKOFFS", scene.time_offset_s, "s, the camera's clock minus UTC"
    if exposure.frames == 1:
        yield "EXPTIME", exposure.duration_s, "s"
    else:
        yield "EXPTIME", exposure.duration_s * exposure.signal_factor, f"s, of the {exposure.stack}"
        yield "NCOMBINE", exposure.frames, "short exposures in the image"
        yield "SUBEXP", exposure.duration_s, "s, of each"
        yield "SUBGAP", exposure.gap_s, "s, from the end of one to the start of the next"
    yield "SITELAT", degrees(site.latitude_rad), "deg north, WGS84"
    yield "SITELONG", degrees(site.longitude_rad), "deg east"
    yield "SITEELEV", site.height_m, "m above the ellipsoid"
    yield "IMAGETYP", "Light Frame", ""
    yield "ROWORDER", "TOP-DOWN", "the first row is the top of the image"
    yield "FRAME", number, "number in truth.jsonl"
    yield "SEED", frame.seed, "of the noise"
    yield "SWCREATE", "glstar", "a simulation"


def _sensor_cards(scene: Scene) -> Iterator[Card]:
    sensor = scene.sensor
    yield "SATURATE", scene.exposure.full_scale_dn(sensor.saturation_dn), "DN"
    yield "BUNIT", "adu", ""
    for keyword, key, comment in _SENSOR_KEYWORDS:
        value = sensor.keys.get(key, sensor.effects.get(f"sensor.{key}"))
        if value is not None and value != "none":
            yield keyword, value.upper() if keyword == "BAYERPAT" and isinstance(value, str) else value, comment


# Keyword, key of [sensor], comment: written if the sensor has the key.
_SENSOR_KEYWORDS = (
    ("GAIN", "analogue_gain", "analogue gain, 1 is the lowest"),
    ("DNPERE", "gain_dn_per_e", "DN/e at gain 1"),
    ("CCD-TEMP", "temperature_c", "deg C, of the sensor"),
    ("BLKLEVEL", "black_level_dn", "DN"),
    ("SKYLEVEL", "sky_mean_dn", "DN, mean of the background"),
    ("BAYERPAT", "mosaic", "colours from the top-left pixel"),
)


def _wcs_cards(wcs: SipCoordinates | None) -> Iterator[Card]:
    if wcs is None:
        return
    yield "WCSAXES", 2, "middle of the exposure"
    projection = "ZPN" if wcs.radial.size else "TAN"
    yield "CTYPE1", f"RA---{projection}-SIP", "astrometric place of the epoch"
    yield "CTYPE2", f"DEC--{projection}-SIP", ""
    yield "RADESYS", "ICRS", ""
    for power, coefficient in zip(_POWERS, wcs.radial, strict=False):
        yield f"PV2_{power}", coefficient, "of the angle from the reference, rad" if power == 1 else ""
    for axis in (0, 1):
        yield f"CRPIX{axis + 1}", wcs.crpix_px[axis] + 1, "px from 1"
        yield f"CRVAL{axis + 1}", degrees(wcs.crval_rad[axis]), "deg"
        yield f"CUNIT{axis + 1}", "deg", ""
    for row in (0, 1):
        for column in (0, 1):
            yield f"CD{row + 1}_{column + 1}", degrees(wcs.cd_rad[row, column]), "deg/px"
    yield "WCSRMS", wcs.rms_px, "px, rms error of the fitted coordinates"
    yield "WCSMAX", wcs.max_px, "px, largest error above the horizon"
    yield "WCSIMAX", wcs.inverse_max_px, "px, largest error of AP and BP"
    for name, coefficients in (("A", wcs.a), ("B", wcs.b), ("AP", wcs.ap), ("BP", wcs.bp)):
        yield f"{name}_ORDER", wcs.order, ""
        for i, j in zip(*np.nonzero(coefficients), strict=True):
            yield f"{name}_{i}_{j}", coefficients[i, j], ""


def _mjd(utc_s: float) -> float:
    return 40587 + utc_s / 86400


def _time(utc_s: float) -> str:
    return format_utc(utc_s).removesuffix("Z")


def _header(lines: list[str]) -> bytes:
    text = "".join(line.ljust(_CARD) for line in [*lines, "END"])
    return (text + " " * (-len(text) % _BLOCK)).encode("ascii")


def _line(keyword: str, value: Value, comment: str) -> str:
    if isinstance(value, bool):
        text = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        escaped = value.replace("'", "''")
        text = f"'{escaped:<8}'".ljust(20)
    elif isinstance(value, int | np.integer):
        text = f"{value:>20}"
    else:
        number = repr(float(value)).upper()
        text = f"{number if '.' in number or 'E' in number else number + '.0':>20}"
    return f"{keyword:<8}= {text}" + (f" / {comment}" if comment else "")


def _ones_complement_sum(content: bytes) -> int:
    """Return the sum of the 32-bit words of a file with carries added at the end: FITS standard, section 4.4.2.7."""
    total = int(np.frombuffer(content, ">u4").sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def _encoded_checksum(total: int) -> str:
    """Return the complement of a sum as 16 characters: FITS standard, appendix J."""
    complement = total ^ 0xFFFFFFFF
    columns = []
    for shift in (24, 16, 8, 0):
        byte = complement >> shift & 0xFF
        quotient, rest = divmod(byte, 4)
        characters = [quotient + rest + 48, quotient + 48, quotient + 48, quotient + 48]
        # Characters between digits and letters are avoided in pairs, whose sum stays.
        while any(58 <= one <= 64 or 91 <= one <= 96 for one in characters):
            for first in (0, 2):
                if any(58 <= one <= 64 or 91 <= one <= 96 for one in characters[first : first + 2]):
                    characters[first] += 1
                    characters[first + 1] -= 1
        columns.append(characters)
    text = "".join(chr(columns[byte][k]) for k in range(4) for byte in range(4))
    return text[-1] + text[:-1]


def damage_of_fits(start: bytes, size: int) -> str:
    """Return a message on the damage of a FITS file that glstar wrote; empty if there is none.

    `start` is at least its header, or its first `FITS_START` bytes; `size` is that of the file, bytes.
    """
    if not start.startswith(b"SIMPLE  ="):
        return "does not begin as a FITS file"
    header = _header_of(start)
    if header is None:
        return "has a damaged FITS header"
    bytes_, (rows, columns) = header
    expected = bytes_ + -(-2 * rows * columns // _BLOCK) * _BLOCK
    return "" if size == expected else f"is cut short: {size} of {expected} bytes"


def _header_of(start: bytes) -> tuple[int, tuple[int, int]] | None:
    """Return the length of a header, bytes, and the size of its image (rows, columns); None if it is damaged."""
    ends = [at for at in range(0, len(start) - _CARD + 1, _CARD) if start[at : at + _CARD].rstrip() == b"END"]
    sides = [re.search(rb"NAXIS%d  = +(\d+)" % axis, start) for axis in (2, 1)]
    if not ends or sides[0] is None or sides[1] is None:
        return None
    return -(-(ends[0] + _CARD) // _BLOCK) * _BLOCK, (int(sides[0][1]), int(sides[1][1]))


def decode_fits(content: bytes) -> NDArray[Any]:
    """Decode a FITS file that glstar wrote, and that `damage_of_fits` accepts, (height, width) uint16.

    Raises ValueError if the checksum of the file is wrong.
    """
    header = _header_of(content)
    assert header is not None
    if _ones_complement_sum(content) not in {0, 0xFFFFFFFF}:
        raise ValueError("is damaged: a wrong checksum")
    length, shape = header
    pixels = np.frombuffer(content, ">i2", shape[0] * shape[1], offset=length).reshape(shape)
    scale = re.search(rb"BSCALE  = +([0-9.]+)", content[:length])
    per_dn = 1 if scale is None else round(1 / float(scale[1]))
    return ((pixels.astype(np.int32) + _ZERO) // per_dn).astype(np.uint16)
