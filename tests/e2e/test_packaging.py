"""The wheel works without the source tree."""

import os
import re
import shutil
import site
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement

import glstar

ROOT = Path(__file__).parents[2]
SHADERS = sorted(path.name for path in (ROOT / "shaders").iterdir() if path.suffix in {".vert", ".frag", ".glsl"})
ASSETS = sorted(
    path.relative_to(ROOT / "assets").as_posix()
    for path in (ROOT / "assets").rglob("*")
    if path.is_file() and path.suffix not in {".py", ".pyc"}
)
MODULES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "glstar").rglob("*.py"))

pytestmark = pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="these tests are about the checkout")

# Reads all that is bundled, through the functions that the program uses.
READ_ALL = """
import sys
from pathlib import Path
import glstar, glstar.system.resources as resources
home = Path(glstar.__file__).parent
print(home)
shaders, assets = (names.split(",") for names in sys.argv[1:])
for name in shaders:
    assert len(resources.shader(name)) > 50, name
for name in assets:
    path = resources.asset(name)
    assert path.stat().st_size > 50, name
    assert path.is_relative_to(home), f"{path} lies outside of the installation"
from glstar.sky.catalogue.reading import StarCatalogue
print(StarCatalogue.open("bsc5").count)
"""


def run(*command: object, cwd: Path, **environment: str) -> str:
    """Run a program outside the checkout and return its output."""
    child = ended(*command, cwd=cwd, **environment)
    assert child.returncode == 0, f"{child.stdout[-2000:]}\n{child.stderr[-2000:]}"
    return child.stdout


def ended(*command: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program outside the checkout, without Python's environment variables; it may fail."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_", "VIRTUAL_"))}
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=kept | environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        timeout=200,
    )


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("build")
    tree = folder / "tree"
    leave_out = shutil.ignore_patterns(".*", "*.egg-info", "__pycache__", "build", "dist", "site-packages")
    shutil.copytree(ROOT, tree, ignore=leave_out)
    # No isolation: the build uses no network.  PYTHONPATH may provide setuptools.
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", tree]
    child = ended(*build, cwd=folder, **{name: os.environ[name] for name in ("PYTHONPATH",) if name in os.environ})
    assert child.returncode == 0, child.stderr
    # Folders that a later setuptools leaves out.
    assert "is absent from the `packages` configuration" not in child.stdout + child.stderr
    [sdist], [wheel] = (folder / "dist").glob("*.tar.gz"), (folder / "dist").glob("*.whl")
    return SimpleNamespace(sdist=sdist, wheel=wheel)


@pytest.fixture(scope="module")
def installed(built: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A new environment with the wheel and the libraries of this one."""
    folder = tmp_path_factory.mktemp("fresh")
    environment, elsewhere = folder / "env", folder / "elsewhere"
    elsewhere.mkdir()
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=folder)
    binaries = environment / ("Scripts" if os.name == "nt" else "bin")
    python = binaries / ("python.exe" if os.name == "nt" else "python")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "--no-compile"]
    run(*pip, "--disable-pip-version-check", built.wheel, cwd=elsewhere)
    # A path in a .pth file is searched, but its own .pth files are not read: the editable glstar stays hidden.
    [home] = [Path(line) for line in run(python, "-c", PURELIB, cwd=elsewhere).splitlines()]
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *site.getsitepackages()}
    (home / "libraries-of-the-tests.pth").write_text("\n".join(sorted(libraries)) + "\n", encoding="utf-8")
    return SimpleNamespace(python=python, glstar=binaries / "glstar", home=home, elsewhere=elsewhere)


PURELIB = "import sysconfig; print(sysconfig.get_path('purelib'))"


def test_the_wheel_holds_every_module_shader_and_asset(built: SimpleNamespace) -> None:
    with zipfile.ZipFile(built.wheel) as wheel:
        names = set(wheel.namelist())

    expected = {
        *MODULES,
        *(f"glstar/shaders/{name}" for name in SHADERS),
        *(f"glstar/assets/{name}" for name in ASSETS),
        "glstar/py.typed",
        "glstar/__init__.pyi",
    }
    assert sorted(expected - names) == []
    assert SHADERS
    assert {"bsc5.sqlite", "adelaide.BIN", "glstar.toml", "cameras.toml"} <= set(ASSETS)


def test_the_wheel_holds_nothing_else(built: SimpleNamespace) -> None:
    with zipfile.ZipFile(built.wheel) as wheel:
        names = wheel.namelist()

    assert {name.split("/")[0] for name in names} == {"glstar", f"glstar-{glstar.__version__}.dist-info"}
    assert [name for name in names if "__pycache__" in name or "/." in name] == []
    assert built.wheel.stat().st_size < 5e6  # bytes


def test_the_package_index_would_take_both(built: SimpleNamespace) -> None:
    said = run(sys.executable, "-m", "twine", "check", "--strict", built.sdist, built.wheel, cwd=built.wheel.parent)

    assert said.count("PASSED") == 2


def test_the_wheel_has_its_metadata_and_requirements(built: SimpleNamespace) -> None:
    with zipfile.ZipFile(built.wheel) as wheel:
        [about] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
        metadata = wheel.read(about).decode()

    assert f"\nVersion: {glstar.__version__}\n" in metadata
    assert "\nRequires-Python: >=3.11\n" in metadata
    for name in ("moderngl", "numpy", "pyerfa", "pymavlink", "typer"):
        assert f"\nRequires-Dist: {name}>=" in metadata
    for name in (asset for asset in ASSETS if asset.startswith("LICENSE")):
        assert f"\nLicense-File: assets/{name}\n" in metadata
    astropy = [line for line in metadata.splitlines() if line.startswith("Requires-Dist: astropy")]
    assert all("extra ==" in line for line in astropy), "only building catalogues takes it"


# Versions of packages that lack wheels for some system, and the newest that each system may install; None: not at all.
RELEASES = {
    "glcontext": ("2.3.7", "3.0.0", "3.1.0"),
    "imgui-bundle": ("1.92.5", "1.93.0"),
    "moderngl": ("5.8.2", "5.12.0", "5.13.0"),
    "opencv-contrib-python-headless": ("4.12.0.88", "5.0.0.93"),
}
NEWEST = {name: versions[-1] for name, versions in RELEASES.items()}
LINUX = {"sys_platform": "linux", "platform_version": "#1 SMP PREEMPT Debian 1:6.12.34-1+rpt1 (2025-06-26)"}
MACOS_13 = {"sys_platform": "darwin", "platform_version": "Darwin Kernel Version 22.6.0: Wed Jul  5 22:22:05 PDT 2023"}
MACOS_15 = {"sys_platform": "darwin", "platform_version": "Darwin Kernel Version 24.1.0: Thu Oct 10 21:03:15 PDT 2024"}
INTEL = {"glcontext": "3.0.0", "moderngl": "5.12.0"}
CHOSEN = {
    "linux": (LINUX | {"platform_machine": "x86_64", "python_version": "3.11"}, {}),
    "raspberry-3.13": (LINUX | {"platform_machine": "aarch64", "python_version": "3.13"}, {}),
    "raspberry-3.11": (
        LINUX | {"platform_machine": "aarch64", "python_version": "3.11"},
        {"glcontext": "2.3.7", "moderngl": "5.8.2"},
    ),
    "windows": ({"sys_platform": "win32", "platform_machine": "AMD64", "platform_version": "10.0.22631"}, {}),
    "macos-15": (MACOS_15 | {"platform_machine": "arm64"}, {}),
    "macos-15-intel": (MACOS_15 | {"platform_machine": "x86_64"}, {"imgui-bundle": "1.92.5"} | INTEL),
    "macos-13": (MACOS_13 | {"platform_machine": "arm64"}, {"imgui-bundle": None}),
    "macos-13-intel": (
        MACOS_13 | {"platform_machine": "x86_64"},
        {"imgui-bundle": None, "opencv-contrib-python-headless": "4.12.0.88"} | INTEL,
    ),
}


@pytest.mark.parametrize(("system", "limited"), CHOSEN.values(), ids=CHOSEN)
def test_each_system_takes_the_newest_versions_that_have_wheels_there(
    system: dict[str, str], limited: dict[str, str | None]
) -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        lines = map(Requirement, tomllib.load(file)["project"]["dependencies"])
    wanted = [one for one in lines if one.marker is None or one.marker.evaluate(system)]

    newest: dict[str, str | None] = {}
    for name, versions in RELEASES.items():
        limits = [one.specifier for one in wanted if one.name == name]
        allowed = [version for version in versions if all(version in limit for limit in limits)]
        # moderngl requires glcontext.
        newest[name] = allowed[-1] if limits or name == "glcontext" else None

    assert newest == NEWEST | limited


def test_the_source_distribution_holds_the_sources_of_the_wheel(built: SimpleNamespace) -> None:
    with tarfile.open(built.sdist) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}

    expected = {"pyproject.toml", "README.md", *MODULES, *(f"shaders/{name}" for name in SHADERS)}
    assert sorted((expected | {f"assets/{name}" for name in ASSETS}) - names) == []


def test_an_installed_glstar_reads_every_shader_and_asset(installed: SimpleNamespace) -> None:
    home, stars = run(
        *(installed.python, "-P", "-W", "error", "-c", READ_ALL, ",".join(SHADERS), ",".join(ASSETS)),
        cwd=installed.elsewhere,
    ).splitlines()

    assert Path(home) == installed.home / "glstar", "the installed one, not the checkout's"
    assert stars == "9096"


# What a user's type checker must accept, and what it must refuse: the line with an error says its code.
CONSUMER = """
from typing import assert_type

import numpy as np

import glstar as gs
from glstar.flight import AttitudeTrack

flight = gs.open_flight(gs.asset("adelaide.BIN"))
assert_type(flight, gs.Flight)
assert_type(flight.attitude, AttitudeTrack)
camera = gs.camera_from_preset("imx477:2028x1520", lens_mm=6.0)
assert_type(camera, gs.Camera)
assert_type(camera.width_px, int)
with gs.GLRenderer.headless() as renderer:
    assert_type(renderer, gs.GLRenderer)
gs.open_flight(7)  # arg-type
camera.width  # attr-defined
gs.no_such_name  # attr-defined
"""


def test_an_installed_glstar_gives_its_types_to_a_consumer(installed: SimpleNamespace) -> None:
    (installed.elsewhere / "consumer.py").write_text(CONSUMER, encoding="utf-8")
    expected = [
        (number, line.rpartition("# ")[2])
        for number, line in enumerate(CONSUMER.splitlines(), start=1)
        if "  # " in line
    ]

    child = ended(
        *(sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--hide-error-context"),
        *("--python-executable", installed.python, "--cache-dir", installed.elsewhere / "types", "consumer.py"),
        cwd=installed.elsewhere,
    )

    found = re.findall(r"^consumer\.py:(\d+): error: .*\[([\w-]+)\]$", child.stdout, re.MULTILINE)
    assert [(int(line), code) for line, code in found] == expected, child.stdout + child.stderr


def test_an_installed_glstar_draws_the_bundled_flight(installed: SimpleNamespace) -> None:
    small = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n"
    (installed.elsewhere / "small.toml").write_text(small, encoding="utf-8")

    said = run(
        *(installed.glstar, "export", "--config", "small.toml", "--output", "frames", "--frames", "1"),
        cwd=installed.elsewhere,
    )

    assert said.startswith("1 frame drawn")
    frames = installed.elsewhere / "frames"
    assert sorted(path.name for path in frames.iterdir()) == ["frame_000000.png", "manifest.json", "truth.jsonl"]
    assert run(installed.glstar, "--version", cwd=installed.elsewhere) == f"glstar {glstar.__version__}\n"


def test_an_installed_glstar_does_not_overwrite_its_own_catalogue(installed: SimpleNamespace) -> None:
    child = ended(installed.glstar, "sky", "catalogue", "build", "bsc5", cwd=installed.elsewhere)

    assert child.returncode == 1
    assert "is part of the installation" in child.stderr
    assert len(child.stderr.splitlines()) == 1
