"""Numbers of a user's sensor: binning, bits, cameras, and the message of each mistake."""

import re
from pathlib import Path

import pytest

from glstar.camera import presets
from glstar.camera.model import Camera
from glstar.camera.presets import (
    SensorMode,
    _binned,
    camera_from_preset,
    is_sensor_mode,
    preset_file,
    sensor_mode,
    sensor_preset,
)
from glstar.errors import ConfigError

NUMBERS = {
    "pixel_um": 2.5,
    "bit_depth": 14,
    "gain_dn_per_e": 0.25,
    "analogue_gain_max": 10.0,
    "full_well_e": 15000.0,
    "black_level_dn": 64.0,
    "read_noise_before_gain_e": 1.5,
    "read_noise_after_gain_e": 2.5,
    "dark_current_e_per_s": 0.125,
    "hot_pixels_per_mpx": 100.0,
    "quantum_efficiency": 0.75,
    "photons_per_s_cm2": 1.0e6,
}
MODES = """modes = [
    { size = [640, 480], binning = 1, readout_ms = 40.0, source = "data sheet" },
    { size = [200, 100], binning = 3, readout_ms = 20.5, bit_depth = 10, source = "driver" },
]
"""


def written(folder: Path, modes: str = MODES, head: str = "[AllSky]", **changes: object) -> str:
    """Return the path of a file of one sensor."""
    numbers = {key: f'{{ value = {value}, source = "sheet {key}" }}' for key, value in NUMBERS.items()} | changes
    lines = [head, 'description = "of a user"', *(f"{key} = {value}" for key, value in numbers.items() if value)]
    (folder / "s.toml").write_text("\n".join([*lines, modes]), encoding="utf-8")
    return str(folder / "s.toml")


def refused(folder: Path, **given: object) -> str:
    with pytest.raises(ConfigError) as caught:
        sensor_preset(f"{written(folder, **given)}:allsky")
    assert caught.value.key == "preset"
    return str(caught.value).removeprefix(f"preset: {folder / 's.toml'}: ")


def test_a_sensor_of_a_file_has_its_numbers_and_modes(tmp_path: Path) -> None:
    file = written(tmp_path)
    preset = sensor_preset(f"{file}:ALLSKY")
    assert {key: number.value for key, number in preset.numbers.items()} == NUMBERS
    assert preset.numbers["pixel_um"].source == "sheet pixel_um"
    assert isinstance(preset.numbers["bit_depth"].value, int)
    assert (preset.description, preset.band) == ("of a user", None)
    # Digital numbers of 12 bits become 14 bits.
    same = {key: NUMBERS[key] for key in ("hot_pixels_per_mpx", "quantum_efficiency", "photons_per_s_cm2")}
    full = {
        "bit_depth": 14,
        "gain_dn_per_e": 1.0,
        "full_well_e": 15000.0,
        "black_level_dn": 256.0,
        "read_noise_before_gain_e": 1.5,
        "read_noise_after_gain_e": 2.5,
        "dark_current_e_per_s": 0.125,
        **same,
    }
    assert preset.values == full
    # Nine pixels averaged, in 10 bits.
    binned = {
        "bit_depth": 10,
        "gain_dn_per_e": 0.25 / 4 / 9,
        "full_well_e": 135000.0,
        "black_level_dn": 16.0,
        "read_noise_before_gain_e": 4.5,
        "read_noise_after_gain_e": 7.5,
        "dark_current_e_per_s": 1.125,
        **same,
    }
    first, second = preset.modes
    name = f"{file}:allsky"
    assert first == SensorMode(f"{name}:640x480", 640, 480, 1, 14, 0.04, "data sheet", 2.5, full)
    assert second == SensorMode(f"{name}:200x100", 200, 100, 3, 10, 0.0205, "driver", 7.5, binned)
    assert sensor_mode(f"{file}:AllSky") == first
    assert sensor_mode(f"{file}:AllSky:200X100") == second
    # 6 mm over 7.5 um.
    assert camera_from_preset(f"{file}:allsky:200x100", 6.0) == Camera(200, 100, 800.0, 800.0, 99.5, 49.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"pixel_um": '{ value = 0.0, source = "x" }'}, "[AllSky] is no sensor: pixel_um must be a positive"
                                                        " number, not 0"),
        ({"bit_depth": '{ value = 17, source = "x" }'}, "[AllSky] is no sensor: bit_depth is 17; it must be a"
                                                        " whole number from 1 to 16"),
        ({"bit_depth": '{ value = 0, source = "x" }'}, "[AllSky] is no sensor: bit_depth is 0; it must be a"
                                                       " whole number from 1 to 16"),
        ({"bit_depth": '{ value = 9.5, source = "x" }'}, "[AllSky] is no sensor: bit_depth is 9.5; it must be a"
                                                         " whole number from 1 to 16"),
        ({"full_well_e": "{ value = 5.0 }"}, "[AllSky] is no sensor: full_well_e has no source"),
        ({"full_well_e": '{ source = "x" }'}, "[AllSky] is no sensor: full_well_e has no value"),
        ({"full_well_e": '{ value = "x", source = "x" }'}, "[AllSky] is no sensor: full_well_e must be a"
                                                           " number, not 'x'"),
        ({"full_well_e": ""}, "[AllSky] is no sensor: full_well_e is missing"),
        ({"quantum_efficiency": ""}, "[AllSky] is no sensor: quantum_efficiency is missing"),
        ({"modes": 'modes = [{ size = [5, 4], binning = 65, readout_ms = 1.0, source = "x" }]'},
         "[AllSky] is no sensor: binning is 65; it must be a whole number from 1 to 64"),
        ({"modes": 'modes = [{ size = [5, 4], readout_ms = 1.0, source = "x" }]'}, "[AllSky] is no sensor:"
                                                                                   " binning is missing"),
        ({"modes": 'modes = [{ size = [0, 4], binning = 1, readout_ms = 1.0, source = "x" }]'},
         "[AllSky] is no sensor: size is 0; the size of an image is an integer of 1 or more, px"),
        ({"modes": "[allsky]"}, "[allsky] is there twice, in large and small letters"),
        ({"head": "AllSky = 5\n[other]"}, "[AllSky] is no sensor: it must be a table"),
    ],
)  # fmt: skip
def test_mistakes_of_a_file_are_named(tmp_path: Path, given: dict, message: str) -> None:
    assert refused(tmp_path, **given) == message


def test_the_largest_depth_and_binning_are_valid(tmp_path: Path) -> None:
    modes = 'modes = [{ size = [5, 4], binning = 64, readout_ms = 0.0, bit_depth = 16, source = "x" }]'
    mode = sensor_mode(f"{written(tmp_path, modes)}:allsky")
    assert (mode.binning, mode.bit_depth, mode.readout_s) == (64, 16, 0.0)


def test_names_belong_to_files_sensors_or_cameras(tmp_path: Path) -> None:
    assert (preset_file("a/b.toml:x:1x2"), preset_file("imx477:1x2"), preset_file("a.toml")) == ("a/b.toml", None, None)
    assert [is_sensor_mode(name) for name in ("a.toml:x", "IMX477", "imx477:1x1", "picamhq-6mm", "imx")] == [
        True,
        True,
        True,
        False,
        False,
    ]
    file = written(tmp_path)
    with pytest.raises(
        ConfigError, match=re.escape(f'{file}: there is no sensor "allsk" (did you mean "allsky"? There are allsky)')
    ):
        sensor_preset(f"{file}:allsk")
    with pytest.raises(ConfigError, match=re.escape('there is no sensor "zzz" (there are generic, imx477')):
        sensor_preset("zzz")
    with pytest.raises(ConfigError, match=re.escape("cannot be read: ")):
        sensor_preset(f"{tmp_path / 'none.toml'}:x")
    with pytest.raises(
        ConfigError, match=re.escape(f'the sensor {file}:allsky has no mode "9x9" (its modes are 640x480, 200x100)')
    ) as caught:
        camera_from_preset(f"{file}:allsky:9x9", 6.0)
    assert caught.value.key == "camera.preset"
    with pytest.raises(
        ConfigError, match="is missing: the focal length of the lens before imx477:2028x1520, mm"
    ) as caught:
        camera_from_preset("imx477:2028x1520")
    assert caught.value.key == "camera.lens_mm"
    with pytest.raises(
        ConfigError, match='the sensor "generic" has images of any size; give those of a camera'
    ) as caught:
        camera_from_preset("generic", 6.0)
    assert caught.value.key == "camera.preset"
    with pytest.raises(ConfigError, match=re.escape('there is no camera "zzzz" (there are ')) as caught:
        camera_from_preset("zzzz", 6.0)
    assert caught.value.key == "camera.preset"
    with pytest.raises(
        ConfigError, match='the camera "picamhq-6mm" has a lens of its own; leave lens_mm out'
    ) as caught:
        camera_from_preset("picamhq-6mm", 6.0)
    assert caught.value.key == "camera.lens_mm"
    assert sensor_mode("generic") is None
    assert presets.sensor_presets()["imx477"].band == "imx477"
    assert presets.sensor_presets()["imx296"].band is None


def test_binning_leaves_the_corner_of_the_image() -> None:
    camera = Camera(1015, 763, 900.0, 960.0, 506.5, 379.5, 6.0)
    assert _binned(camera, 3) == Camera(338, 254, 300.0, 320.0, 507 / 3 - 0.5, 380 / 3 - 0.5, 2.0)
