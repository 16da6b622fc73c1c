"""FITS files: read by astropy, with world coordinates that place every star where truth has it."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from astropy.wcs import WCS
from numpy.typing import NDArray

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.export.imagefiles.fits import _radial_of, damage_of_fits, decode_fits, encode_fits, fit_sip
from glstar.export.imagefiles.formats import find_damage
from glstar.render.readout.rows import recorded_times
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.apparent import ASTROMETRY
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

PINHOLE = camera(480, 360, 420.0)
BARREL = replace(PINHOLE, lens=Lens("plumb_bob", (-0.2, 0.05, 0.001, -0.0005, 0.0)))
TILTED = Mount(0.3, np.deg2rad(35), 0.5)  # down to 15 deg above the horizon
PIXELS = (np.arange(480 * 360, dtype=np.uint32).reshape(360, 480) % 65536).astype(np.uint16)


def scene_of(lens=PINHOLE, *, astrometry="erfa", readout=None, **settings) -> tuple[Scene, StarCatalogue]:
    simulator = sky_over_adelaide(lens, **settings)
    simulator = replace(simulator, sky=replace(simulator.sky, astrometry=ASTROMETRY[astrometry]))
    simulator = Simulator.of(simulator.flight, simulator.sky, simulator.camera, simulator.mount, simulator.sensor)
    if readout is not None:  # before a turning aircraft is far from level
        return simulator.scene(Exposure(NIGHT_UTC_S, 0.2, readout_s=0.08, readout=readout)), simulator.sky.catalogue
    return simulator.scene(Exposure(NIGHT_UTC_S + 3, 0.5)), simulator.sky.catalogue


def encoded(scene: Scene) -> bytes:
    return encode_fits(scene, Frame(PIXELS, scene.exposure, 7), number=3)


def errors_px(scene: Scene, catalogue, header) -> NDArray[np.float64]:
    """Return the distances between the stars of a scene and where astropy places the catalogue's coordinates."""
    ids = scene.stars.star_id[scene.visible]
    directions = scene.stars.direction_eq[scene.visible]
    if scene.exposure.readout_s:
        # Beyond the border rows open with the first or the last one.
        positions = recorded_times(scene, directions).positions
        x_y, on_image = positions[1], scene.camera.contains(positions).all(axis=0)
    else:
        x_y = scene.camera.project(scene.shutter.to_camera(directions))[1]
        on_image = scene.camera.contains(x_y)
    row = {int(number): at for at, number in enumerate(catalogue.star_id)}
    at = [row[int(number)] for number in ids[on_image]]
    years = (Time(scene.exposure.mid_utc_s, format="unix") - Time("J2000")).to_value("jd") / 365.25
    dec = catalogue.dec_rad[at] + years * catalogue.pm_dec_rad_per_yr[at]
    ra = catalogue.ra_rad[at] + years * catalogue.pm_ra_cosdec_rad_per_yr[at] / np.cos(dec)
    placed = np.column_stack(WCS(header).all_world2pix(np.degrees(ra), np.degrees(dec), 0))
    assert on_image.sum() > 50
    return np.linalg.norm(placed - x_y[on_image], axis=1)


@pytest.mark.parametrize("lens", [PINHOLE, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("mount", [Mount(), TILTED], ids=["zenith", "low"])
@pytest.mark.parametrize("astrometry", ["paper", "erfa"])
def test_astropy_places_every_star_of_a_fits_image_within_a_twentieth_of_a_pixel(lens, mount, astrometry):
    scene, catalogue = scene_of(lens, mount=mount, astrometry=astrometry)
    with fits.open(BytesIO(encoded(scene))) as file:
        errors = errors_px(scene, catalogue, file[0].header)
    assert errors.max() < 0.05


@pytest.mark.parametrize(
    "lens",
    [
        replace(camera(480, 360, 300.0), lens=Lens("plumb_bob", (-0.28, 0.07, 1e-3, -5e-4, 0.0))),  # to 54 deg
        replace(camera(480, 360, 286.0), lens=Lens("fisheye", (-0.02, 0.003))),  # to 61 deg
        replace(camera(480, 360, 460.0), lens=Lens("omni", (0.9, -0.1, 0.02, 1e-3, -2e-3))),
    ],
    ids=["barrel", "fisheye", "omni"],
)
def test_astropy_inverts_the_coordinates_of_a_wide_lens(lens):
    scene, catalogue = scene_of(lens)
    header = fits.getheader(BytesIO(encoded(scene)))
    assert header["CTYPE1"] == "RA---ZPN-SIP"
    assert errors_px(scene, catalogue, header).max() < 0.01
    assert header["WCSMAX"] < 0.01


@pytest.mark.parametrize(
    ("lens", "corner_deg", "is_tangent"),
    [
        # r = f theta: along the radius the tangent plane's scale is 1 / cos^2, and 1.5 at 35.26 deg.
        (Lens("fisheye", (0.0, 0.0, 0.0, 0.0)), 35.0, True),
        (Lens("fisheye", (0.0, 0.0, 0.0, 0.0)), 35.6, False),
        # As good as a pinhole, of any field.
        (Lens("plumb_bob", (1e-7, 0.0)), 60.0, True),
        (Lens("fisheye", (0.0, 0.0, 0.0, 0.0)), 95.0, False),
    ],
)
def test_the_plane_is_that_of_the_lens_where_the_tangent_plane_changes_by_half(lens, corner_deg, is_tangent):
    half_diagonal_px, corner_rad = 300.0, np.deg2rad(corner_deg)
    f_px = half_diagonal_px / (corner_rad if lens.model == "fisheye" else np.tan(corner_rad))
    assert (_radial_of(replace(camera(480, 360, f_px), lens=lens)).size == 0) == is_tangent


def test_the_projection_of_a_lens_has_its_radius_at_every_angle():
    """OpenCV's fisheye: theta (1 + k1 theta^2 + k2 theta^4 + ...), whose powers are those of ZPN."""
    lens = Lens("fisheye", (-0.05, 0.02, -0.004, 0.0005))
    radial = _radial_of(replace(camera(480, 360, 250.0), lens=lens))
    theta = np.linspace(0.01, 1.2, 50)
    expected = theta * (1 - 0.05 * theta**2 + 0.02 * theta**4 - 0.004 * theta**6 + 0.0005 * theta**8)
    found = sum(c * theta**k for c, k in zip(radial, range(1, 20, 2), strict=True))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("lens", [PINHOLE, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("readout", ["down", "left"])
def test_astropy_places_the_stars_of_a_rolling_shutter_where_their_rows_record_them(lens, readout):
    scene, catalogue = scene_of(
        lens, readout=readout, mount=Mount(0.3, 1.0), roll_rate_rad_per_s=0.4, yaw_rate_rad_per_s=0.3
    )
    header = fits.getheader(BytesIO(encoded(scene)))
    errors = errors_px(scene, catalogue, header)
    assert errors.max() < 0.05
    assert header["WCSMAX"] < 0.01


def test_stars_of_an_image_of_the_zenith_lie_within_the_error_that_its_header_quotes():
    scene, catalogue = scene_of(BARREL, astrometry="erfa")
    with fits.open(BytesIO(encoded(scene))) as file:
        header = file[0].header
        # The catalogue of bright stars has parallaxes up to 0.8", which no polynomial contains: 0.001 px.
        assert errors_px(scene, catalogue, header).max() < header["WCSMAX"] + 0.002
        assert header["WCSMAX"] < 0.005


def test_an_image_with_the_horizon_quotes_its_larger_error():
    scene, catalogue = scene_of(mount=Mount(0.0, np.deg2rad(15), 0.0))
    with fits.open(BytesIO(encoded(scene))) as file:
        header = file[0].header
        assert header["WCSMAX"] > 0.01
        assert np.median(errors_px(scene, catalogue, header)) < header["WCSMAX"]


def test_an_image_without_sky_has_no_world_coordinates():
    scene, _ = scene_of(mount=Mount(0.0, np.deg2rad(-80), 0.0))
    assert fit_sip(scene) is None
    with fits.open(BytesIO(encoded(scene))) as file:
        assert "CTYPE1" not in file[0].header


def test_astropy_reads_the_pixels_the_times_and_valid_checksums():
    scene, _ = scene_of()
    with fits.open(BytesIO(encoded(scene)), checksum=True) as file:  # a wrong checksum is a warning, hence an error
        header = file[0].header
        assert np.array_equal(file[0].data, PIXELS)
        assert header["EXPTIME"] == 0.5
        assert Time(header["DATE-AVG"]).unix == pytest.approx(NIGHT_UTC_S + 3.25, abs=1e-6)
        assert header["SITELAT"] == pytest.approx(-34.93)
        assert file[0].verify_checksum() == file[0].verify_datasum() == 1


def test_a_fits_file_is_decoded_and_its_damage_is_found(tmp_path):
    content = encoded(scene_of()[0])
    assert np.array_equal(decode_fits(content), PIXELS)
    file = tmp_path / "frame_000003.fits"
    for damaged, message in (
        (content, ""),
        (content[:-2880], "is cut short"),
        (content[:4000], "damaged FITS header"),
        (b"XXXX" + content[4:], "does not begin"),
    ):
        file.write_bytes(damaged)
        assert message in find_damage(file)
        assert bool(message) == bool(find_damage(file))
    flipped = bytearray(content)
    flipped[-5000] ^= 1
    assert damage_of_fits(bytes(flipped), len(flipped)) == ""
    with pytest.raises(ValueError, match="wrong checksum"):
        decode_fits(bytes(flipped))
