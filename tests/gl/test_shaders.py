"""The shaders are standard OpenGL 3.3: Khronos's reference compiler accepts them."""

import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import moderngl
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure, Trail
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.segmentation import SHAPE_LIMITS
from glstar.render.opengl import GLRenderer, program
from glstar.system.resources import shader_paths
from tests.support.lenses import LENSES
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

COMPILER = shutil.which("glslangValidator")
LATER_S = NIGHT_UTC_S + 1
SHORT = Exposure(LATER_S, 0.1)


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> set[tuple[str, str]]:
    """Record the file names and sources that are compiled from now on."""
    sources: set[tuple[str, str]] = set()

    def defined(file: str, constants: dict[str, int], generated: Mapping[str, str]) -> str:
        source = given(file, constants, generated)
        sources.add((file, source))
        return source

    given = program._defined
    monkeypatch.setattr(program, "_defined", defined)
    return sources


@pytest.mark.skipif(COMPILER is None, reason="Debian's glslang-tools has the compiler")
def test_the_reference_compiler_accepts_every_shader(
    compiled: set[tuple[str, str]], context: moderngl.Context, tmp_path: Path
) -> None:
    compile_all_programs(context)
    names = {name for name, _ in compiled}
    programs = [path.name for path in shader_paths() if path.suffix != ".glsl"]
    assert names == set(programs)

    files = []
    for number, (name, source) in enumerate(sorted(compiled)):
        files.append(tmp_path / f"{number}-{name}")
        files[-1].write_text(source, encoding="utf-8")
    assert COMPILER is not None
    report = subprocess.run([COMPILER, *files], capture_output=True, text=True, check=False)

    assert report.returncode == 0, report.stdout


def test_the_trail_shaders_have_the_limits_that_the_segmentation_respects(
    compiled: set[tuple[str, str]], context: moderngl.Context
) -> None:
    GLRenderer(context).close()

    (source,) = (source for name, source in compiled if name == "star_path.frag")

    assert f"#define SHORT_SIGMA {SHAPE_LIMITS.short_sigma}\n" in source
    assert f"#define MAX_FLUX_VARIATION {SHAPE_LIMITS.max_flux_variation}\n" in source
    assert f"#define MAX_END_FLUX {SHAPE_LIMITS.max_end_flux}\n" in source


def compile_all_programs(context: moderngl.Context) -> None:
    with GLRenderer(context) as renderer:
        for lens in (None, *LENSES.values()):
            draw(renderer, lens)
            for sigma_px in (0.8, 1.2):
                for trail in ("analytic", "sprites"):
                    draw(renderer, lens, Sensor(psf_sigma_px=sigma_px), trail, Exposure(LATER_S, 0.1, readout_s=0.05))
            # Long trails, whose ends are drawn on their own.
            narrow, rolling = Sensor(psf_sigma_px=0.6), Exposure(LATER_S, 0.5, readout_s=0.05)
            draw(renderer, lens, narrow, "analytic", rolling, rate_rad_per_s=0.8)
    for shrinks in (0, 1, 2):
        for compares in (0, 1):
            made = program.linked(context, "whole_image.vert", "display.frag", SHRINKS=shrinks, COMPARES=compares)
            made.release()
    program.linked(context, "whole_image.vert", "processed.frag").release()


def draw(
    renderer: GLRenderer,
    lens: Lens | None,
    sensor: Sensor | None = None,
    trail: Trail = "auto",
    exposure: Exposure = SHORT,
    rate_rad_per_s: float = 0.0,
) -> None:
    simulator = sky_over_adelaide(
        replace(camera(160, 120, 150.0), lens=lens), sensor=sensor, roll_rate_rad_per_s=rate_rad_per_s
    )
    renderer.render(simulator.scene(replace(exposure, trail=trail)), seed=0)
