"""Shaders with their includes and errors, contexts and devices, and the develop pass's sources, without drawing."""

import ctypes.util
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.errors import ContextError, RenderError, ShaderError
from glstar.render.effects import EFFECTS, Effect, EffectTexture, Stage
from glstar.render.effects.effect import ChargeTransfer
from glstar.render.opengl import context as contexts
from glstar.render.opengl import program as programs
from glstar.render.opengl import targets as target_module
from glstar.render.opengl.context import EGLDevice, adopt_context, egl_devices, headless_context
from glstar.render.opengl.passes import develop
from glstar.render.opengl.passes import display as display_module
from glstar.render.opengl.passes.display import DisplayPass, Placement, Tone, WindowPart
from glstar.render.opengl.passes.enlarge import _reduced_clock
from glstar.render.opengl.program import linked, set_uniforms, set_used_uniforms
from glstar.render.opengl.renderer import _have_same_light, _require_single
from glstar.render.opengl.targets import FrameReadback, Readback, Targets
from glstar.render.opengl.textures import ReadoutClock
from tests.support import fakegl
from tests.support.scenes import camera, stars_at

SOURCES = {
    "a.vert": '#version 330 core\n#include "b.glsl"\nvoid main() {\n}\n',
    "b.glsl": '// b\n#include "c.glsl"\nfloat b;',
    "c.glsl": 'float c;\n#include "b.glsl"',
    "a.frag": '#version 330 core\n  #include "not"\n#include "c.glsl"\nwrong;\n',
}


class Compiler:
    """A context whose driver accepts programs, or refuses them with a message."""

    def __init__(self, log: str = "") -> None:
        self.log = log
        self.given: dict[str, str] = {}

    def program(self, **sources: str) -> Any:
        self.given = sources
        if self.log:
            raise moderngl.Error(self.log)
        return fakegl.Program()


def test_a_program_has_its_includes_once_and_its_constants() -> None:
    compiler = Compiler()
    program = linked(compiler, "a.vert", "a.frag", generated=SOURCES, ROWS=1, SIGMA=0.5)
    assert program.extra == {}
    defined = "#define ROWS 1\n#define SIGMA 0.5\n#line 2\n"
    assert compiler.given == {
        "vertex_shader": f"#version 330 core\n{defined}// b\nfloat c;\nfloat b;\nvoid main() {{\n}}\n",
        "fragment_shader": f'#version 330 core\n{defined}  #include "not"\nfloat c;\n// b\nfloat b;\nwrong;\n',
    }


@pytest.mark.parametrize(
    ("log", "file", "line"),
    [
        ("fragment_shader\n0:2(1): warning: x\n0:6(1): error: wrong", "a.frag", 4),
        ("fragment_shader\n0(3) : error C0000: wrong", "c.glsl", 1),
        ("vertex_shader\nERROR: 0:4: wrong", "b.glsl", 3),
        ("vertex_shader\nERROR: 0:5: wrong", "a.vert", 3),
        ("vertex_shader\nERROR: 0:6: wrong", "a.vert", 4),
        ("vertex_shader\nERROR: 0:7: wrong", "a.vert", None),
        ("linking failed", "a.vert", None),
    ],
)
def test_an_error_of_the_driver_names_the_line_of_the_file(log: str, file: str, line: int | None) -> None:
    with pytest.raises(ShaderError) as refused:
        linked(Compiler(log), "a.vert", "a.frag", generated=SOURCES, ROWS=1)
    assert (refused.value.file, refused.value.line, refused.value.log) == (file, line, log)
    place = file if line is None else f"{file}:{line}"
    assert str(refused.value) == f"{place}: the driver refuses the shader: {log}"


def test_uniforms_are_sent_when_they_change() -> None:
    sent: list[tuple[str, Any]] = []

    class Recorded(fakegl.Program):
        def __setitem__(self, name: str, value: Any) -> None:
            sent.append((name, value))
            super().__setitem__(name, value)

    program = Recorded("gain", "size")
    set_uniforms(program, gain=2.0, size=(1, 2))
    set_uniforms(program, gain=2.0, size=(1, 3))
    set_used_uniforms(program, gain=3.0, other=1)
    assert sent == [("gain", 2.0), ("size", (1, 2)), ("size", (1, 3)), ("gain", 3.0)]


LINUX = "Debian and Ubuntu: sudo apt-get install libgl1 libegl1"
DARWIN = "macOS has OpenGL of its own, but a session without a screen, such as ssh, may have none"
WINDOWS = (
    "install the driver of the GPU, or set GLCONTEXT_WIN_LIBGL to the opengl32.dll of Mesa for Windows, which draws in"
    " software"
)


@pytest.mark.parametrize(
    ("system", "log", "message"),
    [
        ("linux", " libEGL.so not loaded ", f"no OpenGL to draw with: libEGL.so not loaded. {LINUX}"),
        ("other", "libEGL.so not found", f"no OpenGL to draw with: libEGL.so not found. {LINUX}"),
        ("win32", "opengl32 not found", f"no OpenGL to draw with: opengl32 not found. {WINDOWS}"),
        (
            "linux", "requested device index 7",
            "no such EGL device: requested device index 7; 'glstar doctor' lists them. In a container of NVIDIA's:"
            " NVIDIA_DRIVER_CAPABILITIES=all",
        ),
        (
            "linux", "eglCreateContext failed",
            "this OpenGL is older than 3.3, which glstar needs: eglCreateContext failed; LIBGL_ALWAYS_SOFTWARE=1 draws"
            " with Mesa's software renderer instead; 'glstar doctor' shows more",
        ),
        (
            "darwin", "eglCreateContext failed",
            f"this OpenGL is older than 3.3, which glstar needs: eglCreateContext failed; {DARWIN}; 'glstar doctor'"
            " shows more",
        ),
        ("darwin", "odd", f"no OpenGL to draw with: odd. {DARWIN}; 'glstar doctor' shows more"),
    ],
)  # fmt: skip
def test_a_context_that_fails_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, system: str, log: str, message: str
) -> None:
    def refuse(**_settings: Any) -> None:
        raise Exception(log)  # noqa: TRY002 - as moderngl does

    monkeypatch.setattr(moderngl, "create_context", refuse)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.delenv("GLSTAR_DEVICE", raising=False)
    for make in (headless_context, adopt_context):
        with pytest.raises(ContextError) as refused:
            make()
        assert str(refused.value) == message


def test_a_context_is_asked_for_with_its_version_and_device(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(moderngl, "create_context", lambda **settings: asked.append(settings))
    monkeypatch.setattr(contexts, "keep_freed_memory", lambda: None)
    monkeypatch.delenv("GLSTAR_DEVICE", raising=False)
    plain = {"require": 330, "standalone": True}
    monkeypatch.setattr(sys, "platform", "linux")
    headless_context()
    headless_context(0)
    monkeypatch.setenv("GLSTAR_DEVICE", "3,1")
    headless_context()
    headless_context(2)
    monkeypatch.setattr(sys, "platform", "darwin")
    headless_context()
    adopt_context()
    assert asked == [
        plain | {"backend": "egl"}, plain | {"backend": "egl", "device_index": 0},
        plain | {"backend": "egl", "device_index": 3}, plain | {"backend": "egl", "device_index": 2},
        plain | {"device_index": 3}, {"require": 330},
    ]  # fmt: skip
    monkeypatch.setenv("GLSTAR_DEVICE", "fast,1")
    with pytest.raises(ContextError) as refused:
        headless_context()
    assert str(refused.value) == "GLSTAR_DEVICE='fast,1' is not a number; 'glstar doctor' lists the devices"


class EGL:
    """A library with two devices: a GPU with a device file and CUDA's number, and a software renderer."""

    def __init__(self, extensions: bytes | None) -> None:
        self.extensions = extensions
        self.terminated: list[int] = []
        self.eglQueryString = self._query(lambda display, name: self.extensions if name == 0x3055 else VENDORS[display])
        self.eglGetProcAddress = self._query(lambda name: name)
        self.eglInitialize = self._query(lambda display, _major, _minor: display != 103)
        self.eglTerminate = self._query(self.terminated.append)

    @staticmethod
    def _query(function: Any) -> Any:
        def call(*arguments: Any) -> Any:
            return function(*arguments)

        return call


VENDORS = {101: b"NVIDIA", 102: None, 103: b"never"}
DEVICES = {11: b"EGL_EXT_device_drm EGL_NV_device_cuda", 12: b"EGL_MESA_device_software EGL_NV_device_cuda", 13: None}


def extension_function(_egl: Any, name: str, _result: Any, *arguments: Any) -> Any:
    """Return a function of EGL's extensions for these devices."""

    def devices(most: int, handles: Any, count: Any) -> None:
        count._obj.value = len(DEVICES)
        if handles is not None:
            assert most == len(DEVICES)
            handles[: len(DEVICES)] = list(DEVICES)

    def text(handle: int, name: int) -> bytes | None:
        return DEVICES[handle] if name == 0x3055 else {0x3233: b"/dev/dri/card1"}[name]

    def attribute(handle: int, name: int, value: Any) -> None:
        if handle == 11 and name == 0x323A:
            value._obj.value = 0

    def display(platform: int, handle: int, _settings: None) -> int:
        assert platform == 0x313F
        return handle + 90

    functions = {
        "eglQueryDevicesEXT": (devices, 3), "eglQueryDeviceStringEXT": (text, 2),
        "eglQueryDeviceAttribEXT": (attribute, 3), "eglGetPlatformDisplayEXT": (display, 3),
    }  # fmt: skip
    function, count = functions[name]
    assert len(arguments) == count
    return function


@pytest.mark.parametrize(
    ("extensions", "are_listed"),
    [
        (b"EGL_EXT_device_enumeration", True),
        (b"x EGL_EXT_device_base y", True),
        (b"EGL_EXT_other", False),
        (None, False),
    ],
)
def test_the_devices_of_egl_are_listed(
    monkeypatch: pytest.MonkeyPatch, extensions: bytes | None, are_listed: bool
) -> None:
    egl = EGL(extensions)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: {"EGL": "libEGL.so.1"}[name])
    monkeypatch.setattr(contexts.ctypes, "CDLL", lambda name: {"libEGL.so.1": egl}[name])
    monkeypatch.setattr(contexts, "_function", extension_function)
    found = egl_devices()
    expected = [
        EGLDevice(0, "NVIDIA", "/dev/dri/card1", 0, software=False),
        EGLDevice(1, "unknown", None, None, software=True),
        EGLDevice(2, "does not start", None, None, software=False),
    ]
    assert found == (expected if are_listed else [])
    assert egl.terminated == ([101, 102] if are_listed else [])
    monkeypatch.setattr(ctypes.util, "find_library", lambda _name: None)
    with pytest.raises(ContextError) as refused:
        egl_devices()
    assert str(refused.value) == f"libEGL is not installed. {LINUX}"
    for system in ("darwin", "win32"):
        monkeypatch.setattr(sys, "platform", system)
        assert egl_devices() == []


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


def test_a_reduced_target_opens_with_the_pixels_it_covers() -> None:
    clock = ReadoutClock(1, 1.25, (0.002, 0.003, -0.04))
    reduced = _reduced_clock(clock, 24, 4)
    assert (reduced.rows, reduced.span) == (1, 1.25)
    a, b, c = reduced.opening
    # A position x of the image has x + 24 in the full target, and (x + 4 * 2) / 4 in the reduced one.
    for x, y in ((3.0, 8.0), (50.0, -2.0)):
        full = 0.002 * (x + 24) + 0.003 * (y + 24) - 0.04
        assert a * (x + 8) / 4 + b * (y + 8) / 4 + c == pytest.approx(full, abs=1e-14)


def test_a_target_has_texels_of_sixteen_bytes() -> None:
    context = fakegl.Context()
    for sixteen_bits, per_texel, columns in ((False, 16, 5), (True, 8, 9)):
        targets = Targets(context, 65, 40, 24, sixteen_bits)
        light, image = context.made[-4], context.made[-2]
        assert (light.arguments, light.settings) == (((113, 88), 1), {"dtype": "f4"})
        assert light.filter == (moderngl.NEAREST, moderngl.NEAREST)
        assert (image.arguments, image.settings) == (((columns, 40), 4), {"dtype": "u4"})
        assert (targets.pixels_per_texel, targets.key) == (per_texel, (65, 40, 24, sixteen_bits))
        assert targets.dtype is (np.uint16 if sixteen_bits else np.uint8)
        assert (targets.scene, targets.seed, targets.reads_light) == (None, None, False)
        targets.image = SimpleNamespace(size=(columns, 40), release=lambda: None)
        padded = targets.padded()
        assert (padded.shape, padded.dtype) == ((40, per_texel * columns), targets.dtype)
        targets.scene, targets.seed = SimpleNamespace(exposure="exposure"), 7
        frame = targets.frame(padded, None)
        assert (frame.pixels.shape, frame.exposure, frame.seed, frame.light_dn) == ((40, 65), "exposure", 7, None)
        assert frame.pixels.base is padded
        content = np.arange(113 * 88, dtype=np.float32).reshape(88, 113)
        targets.light = SimpleNamespace(
            size=(113, 88), release=lambda: None,
            read_into=lambda to, content=content, **_settings: to.__setitem__(slice(None), content),
        )  # fmt: skip
        np.testing.assert_array_equal(targets.read_light(), content[24:64, 24:89])
        assert not targets.holds(image)
        targets.release()
        assert (light.releases, image.releases) == (1, 1)


class Current:
    """What makes a context current, and counts how often."""

    entered = 0

    def __enter__(self) -> None:
        self.entered += 1

    def __exit__(self, *_error: object) -> None:
        pass


def test_buffers_of_readback_are_used_again() -> None:
    class Buffer(fakegl.Resource):
        size = property(lambda self: self.settings["reserve"])

        def read_into(self, array: np.ndarray) -> None:
            array[:] = 7

    context, current = fakegl.Context(), Current()
    context.buffer = lambda **settings: context.made.append(Buffer("buffer", **settings)) or context.made[-1]
    readback = Readback(context, current)

    def targets(shape: tuple[int, int]) -> Any:
        return SimpleNamespace(
            padded=lambda: np.zeros(shape, np.uint8), read_image_into=lambda _buffer: None, reads_light=True,
            read_light=lambda: "light", frame=lambda padded, light: (padded, light),
        )  # fmt: skip

    first, second = readback.start(targets((4, 16))), readback.start(targets((4, 16)))
    assert [made.settings for made in context.made] == [{"reserve": 64}] * 2
    pixels, light = first.frame()
    assert (light, pixels.min(), current.entered) == ("light", 7, 1)
    assert first.frame()[0] is pixels
    assert current.entered == 1
    third = readback.start(targets((4, 16)))
    assert len(context.made) == 2
    second.discard()
    with pytest.raises(RenderError) as refused:
        second.frame()
    assert str(refused.value) == "this frame has been discarded"
    other = readback.start(targets((8, 16)))
    assert [made.releases for made in context.made] == [0, 1, 0]
    readback.release()
    assert [made.releases for made in context.made] == [1, 1, 1]
    for pending in (third, other):
        with pytest.raises(RenderError) as refused:
            pending.frame()
        assert str(refused.value) == "this renderer is closed; make another"
    whole = FrameReadback(readback, "frame")
    assert whole.frame() == "frame"
    whole.discard()
    with pytest.raises(RenderError, match="discarded"):
        whole.frame()


def test_the_library_that_waits_is_found_by_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    class Library:
        def __init__(self) -> None:
            self.calls: list[str] = []
            self.glFinish = SimpleNamespace()
            self.glFlush = SimpleNamespace()

    library = Library()

    def open_library(name: str) -> Any:
        asked.append(name)
        if name == "libOpenGL.so.0":
            raise OSError(name)
        return library

    monkeypatch.setattr(target_module.ctypes, "CDLL", open_library)
    find = target_module._library.__wrapped__
    for system, names in (
        ("linux", ["libOpenGL.so.0", "libGL.so.1"]), ("win32", ["opengl32"]), ("other", []),
        ("darwin", ["/System/Library/Frameworks/OpenGL.framework/OpenGL"]),
    ):  # fmt: skip
        monkeypatch.setattr(sys, "platform", system)
        asked.clear()
        assert find() is (library if names else None)
        assert asked == names
    assert (library.glFinish.restype, library.glFlush.argtypes) == (None, [])
    waited: list[str] = []
    there = SimpleNamespace(glFinish=lambda: waited.append("library"), glFlush=lambda: waited.append("flush"))
    here: Any = SimpleNamespace(finish=lambda: waited.append("context"))
    for found in (there, None):
        monkeypatch.setattr(target_module, "_library", lambda found=found: found)
        target_module.wait_until_drawn(here)
        target_module.start_drawing()
    assert waited == ["library", "flush", "context"]


def test_scenes_have_the_same_light_while_stars_camera_and_exposure_stay() -> None:
    scene = stars_at([[5.0, 5.0]], [3.0], sensor=Sensor(), lens=camera())
    keys = {"sensor.psf"}
    darker = replace(scene, sensor=replace(scene.sensor, sky_mean_dn=40.0))
    assert _have_same_light(scene, scene, keys)
    assert _have_same_light(darker, scene, keys)
    later = replace(scene, exposure=replace(scene.exposure, start_utc_s=9.0))
    assert _have_same_light(later, scene, keys)
    exposure = scene.exposure
    for other in (
        replace(scene, stars=replace(scene.stars)),
        replace(scene, draw_list=replace(scene.draw_list)),
        replace(scene, trails=replace(scene.trails)),
        replace(scene, bodies="bodies"),
        replace(scene, camera=camera(f_px=301.0)),
        replace(scene, exposure=replace(exposure, duration_s=0.6)),
        replace(scene, exposure=replace(exposure, readout_s=0.01)),
        replace(scene, exposure=replace(exposure, readout="up")),
        replace(scene, sensor=replace(scene.sensor, psf_sigma_px=2.0)),
        replace(scene, sensor=replace(scene.sensor, effects={"sensor.psf": "moffat"})),
    ):
        assert not _have_same_light(other, scene, keys)
    stack = replace(scene, shorts=(scene,))
    for asked, closed, message in (
        (scene, True, "this renderer is closed; make another"),
        (stack, True, "this renderer is closed; make another"),
        (stack, False, "a stacked image has no flux of its own; expose each of Scene.shorts, or call render"),
    ):
        with pytest.raises(RenderError) as refused:
            _require_single(asked, is_closed=closed)
        assert str(refused.value) == message
    _require_single(scene, is_closed=False)
    assert programs._NONE == {}


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
