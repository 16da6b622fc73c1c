"""Sources, textures and charge of the develop pass, and targets and programs of the display, without drawing."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.effects import EFFECTS, Effect, EffectTexture, Stage
from glstar.render.effects.effect import ChargeTransfer
from glstar.render.opengl.passes import develop
from glstar.render.opengl.passes import display as display_module
from glstar.render.opengl.passes.display import DisplayPass, Placement, Tone, WindowPart
from tests.support import fakegl
from tests.support.scenes import camera, stars_at


def effect(name: str, glsl: str, stage: Stage = Stage.SKY, **more: Any) -> Effect:
    return Effect(name, name, (), stage, glsl, **more)


def test_numbers_of_effects_pass_through_the_vertex_shader() -> None:
    one = effect("one", "uniform float gain, level_dn; // of one\nuniform sampler2D map;\nvec4 one() {}")
    two = effect("two", "uniform uvec3 size;\nuniform ivec2 at,to;\n  uniform int not;")
    sources = develop.composed_sources([one, two])
    assert sources.by_name["effect one"] == (
        "flat in float gain, level_dn; // of one\nuniform sampler2D map;\nvec4 one() {}\n"
    )
    assert sources.by_name["effect two"] == "flat in uvec3 size;\nflat in ivec2 at,to;\n  uniform int not;\n"
    assert sources.by_name["effects.glsl"] == (
        '#include "effect one"\n#include "effect two"\nvec4 with_effects(vec4 signal_dn, uvec2 quad) {\n'
        "    signal_dn = one(signal_dn, quad);\n    signal_dn = two(signal_dn, quad);\n    return signal_dn;\n}\n"
    )
    names = ("gain", "level_dn", "size", "at", "to")
    kinds = ("float", "float", "uvec3", "ivec2", "ivec2")
    declared = [
        f"uniform {kind} given_{name};\nflat out {kind} {name};" for kind, name in zip(kinds, names, strict=True)
    ]
    assert sources.by_name["numbers of effects"] == "\n".join(
        [*declared, "void set_numbers_of_effects() {", *(f"    {name} = given_{name};" for name in names), "}", ""]
    )
    assert sources.numbers == {f"given_{name}": name for name in names}
    assert set(sources.by_name) == {"effect one", "effect two", "effects.glsl", "numbers of effects"}


def test_at_most_48_components_pass_through_the_vertex_shader() -> None:
    # 11 vectors of four, one of three and a number: 48.
    first = f"uniform vec4 {', '.join(f'v{k}' for k in range(11))};\nuniform vec3 w;"
    for last, fits in (("uniform uint last;", True), ("uniform vec2 last;", False), ("uniform int a, b;", False)):
        sources = develop.composed_sources([effect("many", f"{first}\n{last}")])
        line = sources.by_name["effect many"].splitlines()[2]
        assert line == (last.replace("uniform", "flat in") if fits else last)
        assert len(sources.numbers) == (13 if fits else 12)


def test_runs_of_lines_are_rectangles() -> None:
    chosen = np.array([True, True, False, False, True, False, True])
    assert develop._rectangles(chosen, (7, 30), by_columns=True) == [(0, 0, 2, 30), (4, 0, 1, 30), (6, 0, 1, 30)]
    assert develop._rectangles(chosen, (9, 7), by_columns=False) == [(0, 0, 9, 2), (0, 4, 9, 1), (0, 6, 9, 1)]
    assert develop._rectangles(np.zeros(3, bool), (3, 4), by_columns=True) == []


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_charge_moves_in_lines_that_pass_the_threshold(along: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(develop, "_LINES_AT_ONCE", 3)
    random = np.random.default_rng(4)
    signal = random.uniform(0, 90, (10, 3, 4)).astype(np.float32)
    width_px = 10
    image = signal.reshape(10, 12)
    image[[1, 2, 4, 7, 9], [0, 3, 4, 8, 9]] = 100.5
    image[3, 5] = 100.0
    image[5, 11] = 120.0  # beyond the last column
    seen: list[np.ndarray] = []

    def moved(lines: np.ndarray) -> np.ndarray:
        assert lines.dtype == np.float64
        seen.append(lines.copy())
        return lines[:, ::-1] + 0.5

    before = image.copy()
    develop._transfer_charge(ChargeTransfer(along, 100.0, moved), signal, width_px)
    expected = before.copy()
    if along == "columns":
        columns = np.flatnonzero(before.max(axis=0) > 100)
        expected[:, columns] = before[::-1][:, columns] + 0.5
    else:
        rows = np.flatnonzero(before[:, :10].max(axis=1) > 100)
        expected[rows, :10] = before[rows, 9::-1] + 0.5
    np.testing.assert_allclose(signal.reshape(10, 12), expected, rtol=1e-6)
    lengths = [len(lines) for lines in seen]
    assert lengths == ([3, 3] if along == "columns" else [3, 2])


def test_effects_that_change_few_pixels_are_drawn_around_them_in_large_images() -> None:
    def at(count: int) -> Effect:
        return effect("few", "x", only_at=lambda _values, _scene: np.zeros((count, 2), np.int64))

    scene = stars_at([[5.0, 5.0]], [3.0], sensor=Sensor(), lens=camera(1000, 1000))
    few, many = at(500), at(501)
    everywhere = effect("none", "x", only_at=lambda _values, _scene: None)
    plain = effect("plain", "x")
    assert list(develop._changed_px([few, many, everywhere, plain], scene)) == [few]
    small = replace(scene, camera=camera(1000, 999))
    assert develop._changed_px([at(1)], small) == {}
    electrons = Sensor(electrons=ElectronModel(), bit_depth=12)
    quiet = [e.name for e in develop._in_this_pass(electrons, EFFECTS, noiseless=True)]
    noisy = [e.name for e in develop._in_this_pass(electrons, EFFECTS)]
    assert [name for name in noisy if name not in quiet] == ["full_pixels", "shot_noise"]
    assert [e.name for e in develop._in_this_pass(Sensor(), EFFECTS)] == [
        "sky_level", "image_circle", "noise", "quantisation",
    ]  # fmt: skip


def test_textures_of_effects_are_uploaded_by_their_shape() -> None:
    context = fakegl.Context()
    passes = develop.DevelopPass.__new__(develop.DevelopPass)
    passes._context, passes._textures, passes._programs = context, {}, {}
    scene: Any = SimpleNamespace(level=1)
    content = np.arange(6, dtype=np.float32).reshape(2, 3)

    def texture(sampler: str, texels: np.ndarray, *, per_quad: bool = False) -> EffectTexture:
        return EffectTexture(sampler, lambda _v, _s: texels, lambda _v, scene: scene.level, per_quad)

    own, plain = effect("own", "x"), texture("map", content)
    uploaded = passes._texture(own, plain, {}, scene)
    assert (uploaded.arguments[:2], uploaded.settings) == (((3, 2), 1), {"dtype": "f4"})
    np.testing.assert_array_equal(uploaded.arguments[2], content[..., np.newaxis])
    assert (uploaded.repeat_x, uploaded.repeat_y) == (False, False)
    assert passes._texture(own, plain, {}, scene) is uploaded
    scene.level = 2
    again = passes._texture(own, plain, {}, scene)
    assert (uploaded.releases, again.releases, again is uploaded) == (1, 0, False)
    quads = np.array([[[1.5, -2.25, 1e6, -1e6]]])
    half = passes._texture(own, texture("quads", quads, per_quad=True), {}, scene)
    assert (half.arguments[:2], half.settings) == (((1, 1), 4), {"dtype": "f2"})
    assert half.arguments[2].dtype == np.float16
    assert half.arguments[2].ravel().tolist() == [1.5, -2.25, 65504.0, -65504.0]
    assert half.filter == (moderngl.NEAREST, moderngl.NEAREST)
    passes.release()
    assert [made.releases for made in context.made] == [1, 1, 1]


def test_a_part_of_a_window_is_cut_at_its_edges() -> None:
    part = WindowPart(None, (200, 100), (30, 10), (40, 5, 150, 80), (0.1, 0.2, 0.3))
    assert part.screen_from_fragment_px == (-30.0, 89.0, 1.0, -1.0)
    # Left, top, width and height within the part; left and bottom within the window.
    assert part.scissor((20, 30, 40, 15)) == (50, 45, 40, 15)
    assert part.scissor((0, 0, 300, 300)) == (40, 20, 110, 70)
    assert part.scissor((5, -20, 20, 40)) == (40, 70, 15, 25)
    assert part.scissor((150, 90, 10, 10)) == (180, 20, 0, 0)


def test_the_target_of_the_display_stays_while_its_size_does() -> None:
    context = fakegl.Context()
    context.detect_framebuffer = lambda _number: "screen"
    display = DisplayPass(context)
    target, texture = display._target_of((30, 20))
    assert (texture.arguments, texture.filter) == (((30, 20), 4), (moderngl.NEAREST, moderngl.NEAREST))
    assert target.arguments == ([texture],)
    assert display._target_of((30, 20)) == (target, texture)
    other, larger = display._target_of((31, 20))
    assert (target.releases, texture.releases, larger.size) == (1, 1, (31, 20))
    colours = np.arange(768, dtype=np.uint8).reshape(256, 3)
    mapped = display._colour_map_of(colours)
    assert (mapped.arguments, mapped.settings) == (((256, 1), 3), {"alignment": 1})
    assert display._colour_map_of(colours // 2 + 1) is mapped
    assert mapped.written().tolist() == (colours // 2 + 1).tobytes()
    assert mapped.calls[-1][2] == {"alignment": 1}
    display.close()
    display.close()
    assert [made.releases for made in (target, texture, other, larger, mapped)] == [1] * 5


def test_a_program_of_the_display_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[tuple[str, str, dict[str, float]]] = []

    def link(_context: Any, vertices: str, fragments: str, **constants: float) -> fakegl.Program:
        compiled.append((vertices, fragments, constants))
        program = fakegl.Program()
        program.release = lambda: compiled.append(("released", fragments, {}))
        return program

    monkeypatch.setattr(display_module, "linked", link)
    context = fakegl.Context()
    context.detect_framebuffer = lambda _number: "screen"
    display = DisplayPass(context)
    placement = Placement((30, 20), (1.5, -2.5), 1.25, (0, 0, 30, 20))
    tone = Tone(0.1, 2.0, 0.5, None, night=True)
    image = fakegl.Resource("texture", (30, 20), 1, dtype="u1")
    first = display._prepared(image, 4095, placement, tone, None, None)
    assert display._prepared(image, 4095, placement, tone, None, None) is first
    assert compiled == [("whole_image.vert", "display.frag", {"SHRINKS": 1, "COMPARES": 0, "COLOURED": 0})]
    assert first.arguments[0] == {
        "simulated": 0, "screen_from_fragment_px": (0.0, 0.0, 1.0, 1.0), "backdrop": (0.0, 0.0, 0.0, 0.0),
        "corner_px": (1.5, -2.5), "image_px_per_screen_px": 1.25, "simulated_white_dn": 4095.0, "black": 0.1,
        "boost": 2.0, "softening": 0.5, "per_asinh": pytest.approx(1 / np.arcsinh(0.5)), "night": 1,
    }  # fmt: skip
    assert (image.repeat_x, image.repeat_y) == (False, False)
    assert image.calls == [("use", (), {"location": 0})] * 2
    part = WindowPart(None, (200, 100), (30, 10), (40, 5, 150, 80), (0.25, 0.5, 0.75))
    processed = np.zeros((20, 30, 3), np.uint8)
    shown = display._prepared(processed, 255, placement, replace(tone, softening=0.0, night=False), None, part)
    assert display._prepared(processed, 255, placement, tone, None, part) is shown
    assert shown.arguments[0] == {
        "processed": 0, "screen_from_fragment_px": (-30.0, 89.0, 1.0, -1.0), "backdrop": (0.25, 0.5, 0.75, 1.0),
        "corner_px": (1.5, -2.5), "image_px_per_screen_px": 1.25, "night": 1,
    }  # fmt: skip
    (uploaded,) = (made for made in context.made if made.kind == "texture")
    assert [call[:1] + call[2:] for call in uploaded.calls if call[0] == "use"] == [("use", {"location": 0})] * 2
    linear = display._prepared(image, 255, placement, replace(tone, softening=0.0), None, part)
    assert linear.arguments[0]["per_asinh"] == 0.0
    for coarseness, shrinks in ((1.0, 0), (1.01, 1), (2.0, 1), (2.01, 2)):
        coarse = replace(placement, image_px_per_screen_px=coarseness)
        display._prepared(image, 255, coarse, tone, None, None)
        assert {"SHRINKS": shrinks, "COMPARES": 0, "COLOURED": 0} in [constants for *_, constants in compiled]
    assert len(compiled) == 4
    display.close()
    assert sorted(fragments for kind, fragments, _ in compiled if kind == "released") == [
        "display.frag", "display.frag", "display.frag", "processed.frag",
    ]  # fmt: skip


class Readable(fakegl.Resource):
    """A framebuffer whose attachments have some content."""

    content: np.ndarray

    def read_into(self, array: np.ndarray, **settings: Any) -> None:
        self.calls.append(("read_into", (array.shape,), settings))
        array[:] = self.content


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_lines_in_which_charge_moves_are_drawn_again(along: str) -> None:
    # 40 px in three texels of 16; charge moves in the second and third of them, or in the rows 1, 3 and 4.
    largest = np.full((5, 3), 50.0, np.float32)
    largest[[1, 3, 4], [1, 2, 1]] = 101.0
    largest[0, 0] = 100.0
    by_columns = along == "columns"
    chosen = [4, 5, 6, 7, 8, 9] if by_columns else [1, 3, 4]
    shape = (5, 6, 4) if by_columns else (3, 10, 4)
    signal = np.arange(np.prod(shape), dtype=np.float32).reshape(shape) + 101
    context = fakegl.Context()
    contents = [largest, signal]

    def framebuffer(attachments: list[Any]) -> Readable:
        target = Readable("framebuffer", attachments)
        target.content = contents[sum(made.kind == "framebuffer" for made in context.made)]
        context.made.append(target)
        return target

    context.framebuffer = framebuffer
    image: Any = SimpleNamespace(size=(3, 5), height=5, color_attachments=("pixels",), use=lambda: None)
    drawn: list[tuple[Any, Any, dict[str, Any], Any]] = []

    def developed(target: Any, output: Any, textures: Any = develop._NO_TEXTURES, rectangles: Any = ()) -> None:
        drawn.append((target, output, dict(textures), rectangles))

    transfer = ChargeTransfer(along, 100.0, lambda lines: lines + 0.25)
    develop.ChargeTransferPass(context).draw(transfer, 40, image, developed)
    lines = 1 if by_columns else 2
    first, second, last = drawn
    assert [one[1] for one in drawn] == [develop.DevelopOutput(k, lines) for k in (1, 2, 0)]
    assert (last[0], first[2], first[3]) == (image, {}, ())
    found, whole = first[0], second[0]
    assert found.arguments[0][0] == "pixels"
    assert [(made.arguments[0], made.arguments[1]) for made in (found.arguments[0][1], whole.arguments[0][0])] == [
        ((3, 5), 1), (shape[1::-1], 4),
    ]  # fmt: skip
    assert found.calls[0] == ("read_into", ((5, 3),), {"components": 1, "attachment": 1, "dtype": "f4"})
    assert whole.calls[0] == ("read_into", (shape,), {"components": 4, "dtype": "f4"})
    numbers = second[2]["chosen_lines"]
    assert (numbers.arguments[0], numbers.arguments[2].tolist()) == ((len(chosen), 1), chosen)
    np.testing.assert_array_equal(last[2]["moved_dn"].written(), signal + np.float32(0.25))
    assert last[2]["moved_dn"] is whole.arguments[0][0]
    # The number of each line among the chosen ones, where it is one of them.
    positions = last[2]["number_of_line"].arguments[2]
    assert positions[chosen].tolist() == list(range(len(chosen)))
    assert last[3] == ([(1, 0, 2, 5)] if by_columns else [(0, 1, 3, 1), (0, 3, 3, 2)])
    assert [made.releases for made in context.made] == [1] * len(context.made)
    assert all(made.filter == (moderngl.NEAREST, moderngl.NEAREST) for made in context.made if made.kind == "texture")
    # Without a pixel above the full well, the image is drawn once.
    contents[0] = np.minimum(largest, 100)
    context.made.clear()
    drawn.clear()
    develop.ChargeTransferPass(context).draw(transfer, 40, image, developed)
    assert len(drawn) == 1
