"""What the passes of OpenGL read: stars, times, lenses and clocks as arrays, uploaded and released once."""

from dataclasses import replace

import moderngl
import numpy as np
import pytest

from glstar.camera.distortion import LENS_MODELS, Lens, tilt_homography
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import PIXEL_PART_VARIANCE_PX2, Sensor
from glstar.errors import RenderError
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.motion.trailmodels import SAMPLE_SPACING_SIGMA
from glstar.render.opengl import textures
from glstar.render.opengl.drawnlens import PINHOLE, DrawnLens, DrawnLenses, lens_profile
from glstar.render.opengl.passes.path import (
    SegmentKinds,
    StarComponents,
    TextureTable,
    drawn_sigma_px,
    falloff_per_px2,
    still_peak_dn,
)
from glstar.render.opengl.passes.subexposure import sprite_px, with_drawable_sprites
from glstar.render.opengl.targets import GuardBands
from glstar.render.opengl.textures import (
    GLOBAL_SHUTTER,
    ImageTexture,
    PassageTexture,
    ReadoutClock,
    RecentFields,
    StarBuffers,
    packed_stars,
    pointing_texels,
    readout_clock,
    star_texture,
)
from glstar.render.scene.culling import DrawList
from tests.support import fakegl
from tests.support.scenes import camera, star_field, stars_at

LENS = Camera(64, 48, 70.0, 50.0, 30.0, 25.5)


def field_of(count: int, seed: int = 0):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    return star_field(directions / np.linalg.norm(directions, axis=1, keepdims=True), random.uniform(-1, 8, count))


def test_stars_are_packed_with_zeros_after_the_last() -> None:
    field = field_of(5)
    for multiple, rows in ((1, 5), (4, 8), (5, 5), (7, 7)):
        packed = packed_stars(field, multiple=multiple)
        assert (packed.shape, packed.dtype) == ((rows, 4), np.float32)
        np.testing.assert_allclose(packed[:5, :3], field.direction_eq, rtol=1e-6)
        np.testing.assert_allclose(packed[:5, 3], 10 ** (-0.4 * field.vmag), rtol=1e-6)
        assert not packed[5:].any()
    assert packed_stars(field_of(0)).shape == (1, 4)
    assert packed_stars(field_of(0), multiple=3).shape == (3, 4)
    texture = star_texture(fakegl.Context(), field_of(1025))
    assert texture.arguments[:2] == ((1024, 2), 4)
    np.testing.assert_array_equal(texture.arguments[2], packed_stars(field_of(1025), multiple=1024))
    assert (texture.settings, texture.filter) == ({"dtype": "f4"}, (moderngl.NEAREST, moderngl.NEAREST))


def test_times_are_five_texels_each() -> None:
    random = np.random.default_rng(2)
    pointing = Pointing(random.normal(size=(3, 3, 3)), random.normal(size=(3, 3)), random.normal(size=(3, 3)), 0.7)
    for multiple, rows in ((1, 3), (2, 4), (3, 3), (4, 4)):
        texels = pointing_texels(pointing, multiple=multiple)
        assert (texels.shape, texels.dtype) == ((rows, 5, 4), np.float32)
        np.testing.assert_allclose(texels[:3, :3, :3], pointing.C_camera_eq, rtol=1e-6)
        np.testing.assert_allclose(texels[:3, 3, :3], pointing.zenith_eq, rtol=1e-6)
        np.testing.assert_allclose(texels[:3, 4, :3], pointing.velocity_eq, rtol=1e-6)
        assert not texels[..., 3].any()
        assert not texels[3:].any()


def test_two_fields_and_eight_single_stars_stay_uploaded() -> None:
    uploads: list[int] = []

    def upload(field) -> fakegl.Resource:
        uploads.append(len(field))
        return fakegl.Resource("texture", len(uploads))

    recent = RecentFields(upload)
    large, single = [field_of(2, k) for k in range(3)], [field_of(1, k) for k in range(9)]
    first, second = recent.of(large[0]), recent.of(large[1])
    singles = [recent.of(field) for field in single[:8]]
    assert recent.of(large[0]) is first  # the second one is the oldest now
    third = recent.of(large[2])
    assert (first.releases, second.releases, third.releases) == (0, 1, 0)
    assert recent.of(single[0]) is singles[0]
    ninth = recent.of(single[8])
    assert [one.releases for one in singles] == [0, 1, 0, 0, 0, 0, 0, 0]
    assert uploads == [2, 2, *[1] * 8, 2, 1]
    assert recent.of(large[1]) is not second
    assert first.releases == 1
    recent.release()
    assert [one.releases for one in (first, second, third, ninth, *singles)] == [1] * 12


def test_stars_of_a_scene_are_chosen_with_radius_transmission_and_column() -> None:
    context, field = fakegl.Context(), field_of(6)
    stars = StarBuffers(context, field)
    of_stars, of_scene, index = context.made
    np.testing.assert_array_equal(of_stars.arguments[0], packed_stars(field))
    assert index.settings == {"reserve": 24, "dynamic": True}
    drawn = DrawList(np.array([4, 1, 3], np.int32), np.array([5.0, 6.0, 7.0]), extinction_mag=np.array([0.5, 1.0, 2.0]))
    tints = np.arange(24, dtype=np.float32).reshape(6, 4)
    stars.choose(drawn, tints)
    chosen = of_scene.written()
    np.testing.assert_allclose(
        chosen[[4, 1, 3]].T, [[5, 6, 7], 10 ** (-0.4 * np.array([0.5, 1, 2])), [0, 1, 2]], rtol=1e-6
    )
    np.testing.assert_array_equal(chosen[[0, 2, 5]], np.ones((3, 3)))
    np.testing.assert_array_equal(index.written(), [4, 1, 3])
    np.testing.assert_array_equal(context.made[3].written(), tints)
    assert context.made[3].settings == {"reserve": tints.nbytes, "dynamic": True}
    stars.choose(drawn, tints + 1)
    assert len(context.made) == 4
    with_tints, without = fakegl.Program("tints_of_star"), fakegl.Program("other")
    stars._vertices = fakegl_vertices = _ByIdentity()
    for program, count in ((with_tints, 3), (without, 2)):
        vertices = stars.vertices(program)
        layouts = [content[1:] for content in vertices.arguments[1]]
        assert layouts[:2] == [
            ("3f 1f", "direction_eq", "brightness"),
            ("1f 1f 1f", "truncation_radius_px", "transmission", "passage_column"),
        ]
        assert layouts[2:] == [("4f", "tints_of_star")][: count - 2]
        assert vertices.settings == {"index_buffer": index}
        assert stars.vertices(program) is vertices
    stars.release()
    assert [one.releases for one in context.made] == [1] * 6
    assert len(fakegl_vertices) == 0


class _ByIdentity(dict):
    """A dictionary whose keys are programs, by identity, because dictionaries have no hash."""

    def __contains__(self, key: object) -> bool:
        return super().__contains__(id(key))

    def __getitem__(self, key: object) -> object:
        return super().__getitem__(id(key))

    def __setitem__(self, key: object, value: object) -> None:
        super().__setitem__(id(key), value)


def test_the_passage_of_cloud_grows_in_rows_of_1024() -> None:
    context = fakegl.Context()
    passage = PassageTexture(context)
    (first,) = context.made
    assert (first.arguments, first.settings) == (((1, 1), 1), {"dtype": "f4"})
    assert first.written().tolist() == [[1.0]]
    passage.write(np.zeros((0, 0), np.float32))
    assert len(first.calls) == 1
    values = np.arange(2 * 600, dtype=np.float32).reshape(2, 600)
    passage.write(values)
    assert (first.releases, passage.texture.size) == (1, (1024, 2))
    written = passage.texture.written()
    np.testing.assert_array_equal(written.ravel()[:1200], values.ravel())
    assert not written.ravel()[1200:].any()
    passage.write(values[:, :512])
    assert passage.texture.size == (1024, 1)
    last = passage.texture
    passage.write_table(np.ones((1, 1024)))
    assert passage.texture is last
    assert last.written().dtype == np.float32
    passage.write_table(np.ones((3, 5), np.float32))
    assert passage.texture.size == (5, 3)
    passage.release()
    assert [one.releases for one in context.made] == [1] * 4


def test_an_image_is_uploaded_again_only_if_it_is_another() -> None:
    context = fakegl.Context()
    image = ImageTexture(context)
    grey, other = np.zeros((3, 5), np.uint8), np.ones((3, 5), np.uint8)
    texture = image.of(grey)
    assert (texture.arguments, texture.settings) == (((5, 3), 1), {"dtype": "u1", "alignment": 1})
    assert (texture.repeat_x, texture.repeat_y) == (False, False)
    assert image.of(grey) is texture
    assert len(texture.calls) == 1
    assert image.of(other) is texture
    assert texture.written().tolist() == other.tolist()
    colour = image.of(np.zeros((3, 5, 3), np.uint8))
    assert (texture.releases, colour.arguments) == (1, ((5, 3), 3))
    deep = image.of(np.zeros((3, 5), np.uint16))
    assert (deep.settings["dtype"], deep.arguments) == ("u2", ((5, 3), 1))
    assert image.of(np.zeros((5, 3), np.uint16)).size == (3, 5)
    image.release()
    image.release()
    assert [one.releases for one in context.made] == [1] * 4
    assert image.texture is None


@pytest.mark.parametrize(("readout", "size"), [("down", 48), ("right", 64), ("up", 48), ("left", 64)])
def test_a_rolling_shutter_opens_pixel_by_pixel(readout: str, size: int) -> None:
    exposure = Exposure(100.0, 0.25, readout_s=0.05, readout=readout)
    clock = readout_clock(exposure, LENS, 8)
    assert (clock.rows, clock.span) == (1, pytest.approx(1.2, rel=0, abs=1e-12))
    openings = clock.openings(8)
    # Fractions of the time from the first opening to the last closing; positions of pixel centres.
    at = openings.at(np.array([[0.0, 0.0], [63.0, 47.0], [10.0, 20.0]]))
    order = {"down": 20 / 47, "up": 27 / 47, "right": 10 / 63, "left": 53 / 63}[readout]
    first, last = (0.0, 1.0) if readout in ("down", "right") else (1.0, 0.0)
    np.testing.assert_allclose(at, np.array([first, last, order]) * 0.05 / 0.3, rtol=0, atol=1e-12)
    assert openings.open_time == pytest.approx(0.25 / 0.3, rel=1e-12)
    assert openings.per_px == pytest.approx(0.05 / 0.3 / (size - 1))
    # With the guard band, a pixel's centre has the coordinates of gl_FragCoord.
    a, b, c = clock.opening
    assert a * (10 + 8.5) + b * (20 + 8.5) + c == pytest.approx(order * 0.05 / 0.3, rel=0, abs=1e-12)
    program = fakegl.Program("open_time", "opening")
    clock.bind(program)
    assert program == {"open_time": pytest.approx(0.25 / 0.3, rel=0, abs=1e-12), "opening": clock.opening}


def test_a_global_shutter_has_no_clock() -> None:
    assert readout_clock(Exposure(100.0, 0.25), LENS, 8) is GLOBAL_SHUTTER
    assert ReadoutClock(0, 1.0, (0.0, 0.0, 0.0)) == GLOBAL_SHUTTER
    assert GLOBAL_SHUTTER.openings(8) is None
    program = fakegl.Program("open_time", "opening")
    GLOBAL_SHUTTER.bind(program)
    assert program == {"open_time": None, "opening": None}


@pytest.mark.parametrize(
    ("lens", "kind"),
    [
        (Lens("rational", (0.3, 0.08, 6e-4, -4e-4, 0.01, 0.62, 0.18, 0.02, 2e-3, 3e-3, -1e-3, 4e-3, 0.02, 0.03)), 1),
        (Lens("plumb_bob", (-0.1, 0.02, 1e-3, 2e-3, 0.003)), 1),
        (Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)), 2),
        (Lens("omni", (1.2, -0.1, 0.02, 1e-3, -1e-3)), 3),
    ],
)
def test_a_lens_is_uniforms_and_a_table(lens: Lens, kind: int) -> None:
    context, seen = fakegl.Context(), replace(LENS, fx_px=390.0, fy_px=380.0, lens=lens)
    lenses = DrawnLenses(context)
    drawn = lenses.of(seen)
    assert lenses.of(seen) is drawn
    limit_rad = view_limit_rad(seen)
    expected = {"lens_limit": np.cos(limit_rad)}
    if kind != 2:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = lens.brown[:12]
        expected |= {"lens_k123": (k1, k2, k3), "lens_k456": (k4, k5, k6), "lens_p12": (p1, p2)}
        # Columns of the matrix one after the other.
        tilt = tilt_homography(lens.brown)
        by_columns = tuple(tilt[row, column] for column in range(3) for row in range(3))
        expected |= {"lens_s1234": (s1, s2, s3, s4), "lens_tilt": by_columns}
    if kind != 1:
        texels, steps_per_s = lens_profile(lens, limit_rad)
        expected |= {"lens_profile": 7, "lens_steps_per_s": steps_per_s}
        (table,) = context.made
        assert (table.arguments[:2], table.settings) == (((2049, 1), 2), {"dtype": "f4"})
        np.testing.assert_array_equal(table.arguments[2], texels)
        assert table.filter == (moderngl.NEAREST, moderngl.NEAREST)
    assert (drawn.kind, drawn.uniforms) == (kind, expected)
    program = fakegl.Program("focal_px", "principal_px", "skew_px", "guard_band_px", "lens_limit")
    drawn.bind(program, replace(seen, skew_px=0.25), 16)
    assert program == {
        "focal_px": (390.0, 380.0), "principal_px": (30.0, 25.5), "skew_px": 0.25, "guard_band_px": 16,
        "lens_limit": np.cos(limit_rad),
    }  # fmt: skip
    assert [call[:2] for made in context.made for call in made.calls] == [("use", (7,))] * len(context.made)
    other = lenses.of(replace(seen, lens=Lens("fisheye", (0.01,))))
    assert other is not drawn
    assert lenses.of(LENS) is PINHOLE
    assert DrawnLens(0, {}, None) == PINHOLE
    lenses.release()
    lenses.release()
    assert [made.releases for made in context.made] == [1] * len(context.made)


@pytest.mark.parametrize(
    ("lens", "limit_deg"),
    [(Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)), 100.0), (Lens("double_sphere", (-0.2, 0.6)), 95.0)],
)
def test_the_table_of_a_lens_has_values_and_slopes(lens: Lens, limit_deg: float) -> None:
    radius = LENS_MODELS[lens.model].radius
    limit_rad = np.deg2rad(limit_deg)
    texels, steps_per_s = lens_profile(lens, limit_rad)
    assert (texels.shape, texels.dtype) == ((2049, 2), np.float32)
    largest = np.sin(limit_rad / 2) ** 2
    assert steps_per_s == pytest.approx(2048 / largest, rel=1e-12)

    def g(s: np.ndarray) -> np.ndarray:
        theta = 2 * np.arcsin(np.sqrt(s))
        return radius(lens.coefficients, theta)[0] / (2 * np.sqrt(s))

    step = largest / 2048
    s = np.arange(1, 2048) * step
    np.testing.assert_allclose(texels[1:-1, 0], g(s), rtol=1e-6)
    h = step / 50
    np.testing.assert_allclose(texels[1:-1, 1], (g(s + h) - g(s - h)) / (2 * h) * step, rtol=2e-5, atol=1e-9)
    # On the axis by extrapolation, and at the limit.
    near = np.array([1e-6, 2e-6, 3e-6])
    np.testing.assert_allclose(texels[0, 0], np.polyval(np.polyfit(near, g(near), 1), 0.0), rtol=1e-6)
    np.testing.assert_allclose(texels[0, 1], np.polyfit(near, g(near), 1)[0] * step, rtol=1e-4)
    np.testing.assert_allclose(texels[-1, 0], g(np.array([largest]))[0], rtol=1e-6)


@pytest.mark.parametrize("sigma_px", [0.55, 1.7])
def test_gaussians_are_drawn_with_the_width_of_a_pixel(sigma_px: float) -> None:
    sensor = Sensor(psf_sigma_px=sigma_px)
    variance = sigma_px**2 + PIXEL_PART_VARIANCE_PX2 if sensor.needs_erf else sensor.effective_sigma_px**2
    assert sensor.needs_erf == (sigma_px < 1)
    assert drawn_sigma_px(sensor) == pytest.approx(np.sqrt(variance), rel=1e-12)
    # exp2 in place of exp: exp(-r^2 / (2 v)) = 2^(-r^2 / (2 v ln 2)).
    assert 2 ** (-falloff_per_px2(sensor) * 2.5**2) == pytest.approx(np.exp(-(2.5**2) / (2 * variance)), rel=1e-12)
    # The flux stays.
    flux = float(sensor.peak_dn(0.0, 0.4)) * sigma_px**2
    assert still_peak_dn(sensor, 0.4) * variance == pytest.approx(flux, rel=1e-12)
    assert still_peak_dn(sensor, 0.4, 1.3) == pytest.approx(1.3 * flux / variance, rel=1e-12)


def test_components_are_rows_of_the_stars_that_are_drawn_together() -> None:
    sensors = tuple(Sensor(psf_sigma_px=sigma) for sigma in (0.6, 0.7, 1.5, 2.5))
    components = StarComponents(sensors, np.array([2, 0, 3, 1, 0]))
    texels = components.texels(0.4, 1.3)
    assert (texels.shape, texels.dtype) == ((2, 5, 3), np.float32)
    for k, number in enumerate(components.of_star):
        sensor = sensors[number]
        row = (drawn_sigma_px(sensor), sensor.effective_sigma_px, still_peak_dn(sensor, 0.4, 1.3))
        np.testing.assert_allclose(texels[0, k], row, rtol=1e-6)
        np.testing.assert_allclose(texels[1, k], (falloff_per_px2(sensor), 0, 0), rtol=1e-6)
    runs = list(components.runs())
    assert [sensor for sensor, _ in runs] == [sensors[0], sensors[2]]
    assert [stars.tolist() for _, stars in runs] == [
        [False, True, False, True, True],
        [True, False, True, False, False],
    ]
    assert SegmentKinds(are_short=True) == SegmentKinds(True, False, False)


def test_a_table_of_paths_grows_in_steps() -> None:
    context = fakegl.Context()
    table, vertices = TextureTable(context, 3), fakegl.Resource("vertex_array")
    filled = table.filled(vertices, 300, 17)
    assert [texture.arguments for texture in filled] == [((512, 32), 4)] * 3
    target = context.made[-1]
    assert (target.kind, target.viewport, target.arguments) == ("framebuffer", (0, 0, 300, 17), (filled,))
    assert [call[0] for call in target.calls] == ["clear", "use"]
    assert vertices.calls == [("render", (moderngl.TRIANGLES,), {"vertices": 3})]
    assert table.filled(vertices, 512, 32) is filled
    wider = table.filled(vertices, 513, 5)
    assert [texture.size for texture in wider] == [(768, 32)] * 3
    higher = table.filled(vertices, 1, 33)
    assert [texture.size for texture in higher] == [(768, 48)] * 3
    table.release()
    assert [made.releases for made in context.made] == [1] * 12
    assert [texture.size for texture in table.filled(vertices, 256, 16)] == [(256, 16)] * 3


def test_a_guard_band_is_a_multiple_of_eight_around_the_brightest_star() -> None:
    context = fakegl.Context(GL_MAX_TEXTURE_SIZE=400)
    bands = GuardBands(context)
    sensor = Sensor(psf_sigma_px=1.5, reference_peak_dn=200.0, reference_vmag=3.0)
    scene = stars_at([[20.0, 20.0], [50.0, 30.0]], [4.0, 2.0], sensor=sensor, lens=LENS)
    # The brightest star may be invisible: the radius at which its profile is cut.
    drawn = replace(scene, draw_list=scene.draw_list[:1])
    radius_px = float(sensor.truncation_radius_px(sensor.peak_dn(2.0, 0.5)))
    expected = next(width for width in range(8, 200, 8) if width >= radius_px + 1)
    assert bands.of(scene) == bands.of(drawn) == expected
    for radius in (15.0, 15.01, 31.0, 38.9, 39.1):
        wide = replace(scene, draw_list=replace(scene.draw_list, truncation_radius_px=np.array([3.0, radius])))
        assert bands.of(wide) == next(width for width in range(8, 200, 8) if width >= max(radius, radius_px) + 1)
    satellite = replace(wide, draw_list=replace(scene.draw_list, truncation_radius_px=np.array([3.0, 57.0])))
    assert bands.of(replace(scene, satellites=(satellite,))) == 64
    longer = replace(scene, exposure=replace(scene.exposure, duration_s=5000.0))
    assert bands.of(longer) >= expected
    for width_px, fits in ((400 - 2 * expected, True), (401 - 2 * expected, False)):
        for seen in (replace(LENS, width_px=width_px), replace(LENS, height_px=width_px)):
            if fits:
                assert bands.of(replace(scene, camera=seen)) == expected
                continue
            with pytest.raises(RenderError) as refused:
                bands.of(replace(scene, camera=seen))
            assert str(refused.value) == (
                f"an image of {seen.width_px} x {seen.height_px} px is larger than this driver draws: at most"
                f" {400 - 2 * expected} px per side"
            )


def test_sprites_are_cut_down_to_what_a_driver_draws() -> None:
    # 3.5 standard deviations on both sides, and the path during four sub-exposures.
    assert sprite_px(2.0, 0.5) == pytest.approx(2 * 3.5 * 2.0 + 4 * SAMPLE_SPACING_SIGMA * 0.5, rel=1e-12)
    whole = Sensor(psf_sigma_px=3.0)
    scene = stars_at([[20.0, 20.0], [50.0, 30.0]], [4.0, 2.0], sensor=whole, lens=camera())
    scene = replace(scene, draw_list=replace(scene.draw_list, truncation_radius_px=np.array([13.0, 20.0])))
    extent_px = sprite_px(0.0, 3.0)
    assert with_drawable_sprites(scene, 3.0, 40.0 + extent_px, whole) is scene
    cut = with_drawable_sprites(scene, 3.0, 39.0 + extent_px, whole)
    np.testing.assert_allclose(cut.draw_list.truncation_radius_px, [13.0, 19.5], rtol=1e-12)
    still = stars_at([[20.0, 20.0], [50.0, 30.0]], [4.0, 2.0], sensor=whole, lens=camera(), n=1)
    still = replace(still, draw_list=scene.draw_list)
    assert with_drawable_sprites(still, 3.0, 40.0, whole) is still
    np.testing.assert_allclose(
        with_drawable_sprites(still, 3.0, 36.0, whole).draw_list.truncation_radius_px, [13, 18], rtol=1e-12
    )
    least_px = 3.5 * whole.effective_sigma_px
    assert with_drawable_sprites(still, 3.0, 2 * least_px + 0.01, whole) is not still
    with pytest.raises(RenderError) as refused:
        with_drawable_sprites(still, 3.0, 15.0, whole)
    allowed = np.floor(10 * 3.0 * 7.5 / least_px) / 10
    assert str(refused.value) == (
        f"sensor.psf_sigma_px = 3 requires sprites of {2 * least_px:.0f} px and this driver draws at most 15 px; it may"
        f" be {allowed:g} px"
    )
    assert allowed > 1


def test_texels_and_columns_are_those_of_the_shaders() -> None:
    assert (textures.TEXELS_PER_TIME, textures.STARS_PER_ROW, textures.PASSAGE_COLUMNS) == (5, 1024, 1024)
