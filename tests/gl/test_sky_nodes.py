"""Sky, cloud and flare, computed at nodes over the image: every pixel against bilinear interpolation of the nodes."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.effects.cloud import frame_transmission
from glstar.render.effects.lensflare import flare_dn
from glstar.render.effects.naturalsky import NATURAL_SKY
from glstar.render.effects.sky import FINE_GRID, node_positions, softened
from glstar.render.opengl import GLRenderer
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

CLOUD = {"cloud.coverage": 0.5, "cloud.optical_depth": 3.0, "cloud.scale_m": 4000.0, "cloud.edge": 0.3}
FLARE = {"flare.scatter": 0.01, "flare.ghost_fraction": 1e-3, "flare.lamp_mag": -18.0, "flare.lamp_altitude_deg": 50.0}
TOWN = {"sky.brightness": "natural", "sky.town_mag_arcsec2": 17.0}


def fisheye(limit_rad):
    return Camera(320, 96, 130.0, 130.0, 159.5, 47.5, 0.0, Lens("fisheye", (), limit_rad))


def scene_of(width_px, effects, *, bit_depth, pitch_deg, lens=None):
    """Return a scene without stars, planets and noise."""
    sensor = Sensor(
        bit_depth=bit_depth,
        reference_peak_dn=(1e4 if bit_depth == 16 else 40.0) * (width_px / 1538) ** 2,
        sky_mean_dn=0.0,
        sky_std_dn=0.0,
        effects=TOWN | effects,
    )
    lens, mount = lens or camera(width_px, 96, 0.9 * width_px), Mount(pitch_rad=np.deg2rad(pitch_deg))
    scene = sky_over_adelaide(lens, sensor=sensor, mount=mount).scene(Exposure(NIGHT_UTC_S + 2.0, 0.5))
    return replace(scene.with_visible(slice(0)), bodies=None)


# With ground in view, two values of the texture of nodes make each four or sixteen pixels, else one of that of spans.
@pytest.mark.parametrize("pitch_deg", [50.0, 0.0])
@pytest.mark.parametrize("bit_depth", [8, 16])
@pytest.mark.parametrize("width_px", [1538, 4100])
def test_every_pixel_is_interpolated_between_nodes(
    renderer: GLRenderer, width_px: int, bit_depth: int, pitch_deg: float
) -> None:
    scene = scene_of(width_px, CLOUD | FLARE, bit_depth=bit_depth, pitch_deg=pitch_deg)
    image = renderer.render(scene, seed=0).pixels.astype(float)

    texels = NATURAL_SKY.textures[0].texels(NATURAL_SKY.values(scene.sensor), scene).astype(np.float64)
    assert texels.shape[1::-1] == FINE_GRID
    np.testing.assert_allclose(
        texels[..., 3], flare_dn(scene, node_positions(scene.camera, FINE_GRID)), rtol=1e-6, atol=1e-6
    )
    is_sky = texels[..., 2] > 0
    assert is_sky.any()
    assert is_sky.all() == (pitch_deg > 10)
    total = np.where(is_sky, texels[..., 0], texels[..., 1]) + texels[..., 3]
    x, y = (
        np.interp(np.arange(n), np.linspace(-0.5, n - 0.5, m), np.arange(m))
        for n, m in zip((width_px, 96), FINE_GRID, strict=True)
    )
    column, row = (np.minimum(at.astype(int), m - 2) for at, m in zip((x, y), FINE_GRID, strict=True))
    across, down = x - column, (y - row)[:, np.newaxis]
    above, below = ((1 - across) * total[r][:, column] + across * total[r][:, column + 1] for r in (row, row + 1))
    expected = np.clip((1 - down) * above + down * below, 0, 2**bit_depth - 1)

    # At the horizon, each pixel shows sky or ground.
    near = np.interp(np.arange(96.0), np.linspace(-0.5, 95.5, FINE_GRID[1]), texels[..., 2].min(axis=1))
    off = np.abs(image - expected)[np.abs(near) > 4 / width_px]
    contrast = np.ptp(expected)
    assert contrast > 20
    # A bend at a node is cut off by the straight line between the columns that are read; distant cloud bends at each.
    assert np.mean(off < 0.51 + 0.01 * contrast) > (0.99 if pitch_deg > 10 else 0.93)
    assert off.max() < 0.51 + (0.1 if pitch_deg > 10 else 0.4) * contrast


def test_softened_edges_keep_their_light() -> None:
    edge = np.zeros((9, 9))
    edge[4, 4] = 16.0
    assert softened(edge)[3:6, 3:6].tolist() == [[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]
    assert softened(np.full((3, 4), 2.5)).tolist() == np.full((3, 4), 2.5).tolist()


# Without ghosts: those of a lamp beyond the circle are missing.
SCATTER = FLARE | {"flare.ghost_fraction": 0.0}


@pytest.mark.parametrize("effects", [{}, CLOUD, SCATTER, CLOUD | SCATTER], ids=["sky", "cloud", "flare", "both"])
@pytest.mark.parametrize("pitch_deg", [60.0, 0.0])
def test_the_sky_is_dark_beyond_the_image_circle_and_the_same_inside_it(
    renderer: GLRenderer, pitch_deg: float, effects: dict[str, float]
) -> None:
    whole = scene_of(320, effects, bit_depth=16, pitch_deg=pitch_deg, lens=fisheye(np.pi))
    cut_off = scene_of(320, effects, bit_depth=16, pitch_deg=pitch_deg, lens=fisheye(np.deg2rad(40.0)))
    expected, image = (renderer.render(scene, seed=0).pixels.astype(float) for scene in (whole, cut_off))

    x, y = np.meshgrid(np.arange(320.0), np.arange(96.0))
    radius_px = np.hypot(x - 159.5, y - 47.5)
    # Nodes are 3.3 px from each other and may be softened, and 8 px are drawn from two values.
    edge_px, soft_px = 130.0 * np.deg2rad(40.0), 16.0
    beyond, inside = radius_px > edge_px + soft_px, radius_px < edge_px - soft_px
    assert image[beyond].max() == 0
    assert expected[beyond].min() > 20
    np.testing.assert_allclose(image[inside], expected[inside], rtol=0, atol=1.0)
    shown = frame_transmission(cut_off)
    assert shown is not None
    assert (shown < 1) == ("cloud.coverage" in effects)
