"""Shaders with their includes and errors, contexts, targets and readback, without drawing."""

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest

from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ContextError, RenderError, ShaderError
from glstar.render.opengl import context as contexts
from glstar.render.opengl import program as programs
from glstar.render.opengl import targets as target_module
from glstar.render.opengl.context import adopt_context, headless_context
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
