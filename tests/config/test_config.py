"""The config: TOML in, nouns out, and what is said to a person who got it wrong."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.presets import camera_from_preset
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError
from glstar.render.effects import EFFECTS
from glstar.system.resources import asset

Write = Callable[..., Path]

CALIB = "image_width: 640\nimage_height: 480\nK: [500, 0.5, 320, 0, 501, 240, 0, 0, 1]\n"
CALIB_CAMERA = Camera(640, 480, 500.0, 501.0, 320.0, 240.0, 0.5)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a file, glstar.toml unless it has another name, and returns its path."""

    def write(text: str, name: str = "glstar.toml") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(path: Path) -> str:
    """The one line with which a config is refused, without the file that it opens with."""
    with pytest.raises(ConfigError) as caught:
        Config.load(path)
    assert caught.value.file == str(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


# --- defaults ---------------------------------------------------------------------------------------------------------


def test_without_a_config_the_bundled_camera_points_at_the_zenith() -> None:
    config = Config()

    assert config.camera() == camera_from_preset("picamhq-6mm-binned4")
    assert config.mount() == Mount()
    assert config.sensor() == Sensor()
    assert config.exposure.rate_hz == Exposure(0.0, 1.0).rate_hz
    assert (config.exposure.duration_s, config.exposure.interval_s) == (0.5, 3.0)
    assert (config.sky.catalogue, config.sky.vmag_limit, config.sky.astrometry) == ("bsc5", 6.5, "paper")
    assert (config.sky.refraction, config.sky.dut1_s) == (True, None)
    assert (config.air.pressure_hpa, config.air.temperature_c) == (1010.0, 10.0)
    assert (config.flight.attitude, config.flight.time_offset_s, config.flight.start_utc_s) == ("auto", 0.0, None)


@pytest.mark.parametrize("text", ["", "# nothing\n", "[camera]\n[sensor]\n"])
def test_an_empty_config_has_the_defaults(write: Write, text: str) -> None:
    assert Config.load(write(text)) == Config()


def test_the_example_has_the_defaults() -> None:
    assert Config.load(asset("glstar.toml")) == Config()


def test_the_example_shows_every_key() -> None:
    example = asset("glstar.toml").read_text(encoding="utf-8")
    shown = tomllib.loads(example)

    for section, keys in Config().resolved().items():
        for key, value in keys.items():
            assert f"{key} = " in example
            assert key not in shown[section] or shown[section][key] == value
    for commented in ("file = ", "utc_start = "):
        assert f"# {commented}" in example


def test_the_commented_keys_of_the_example_are_valid(write: Write) -> None:
    lines = asset("glstar.toml").read_text(encoding="utf-8").splitlines()
    camera = [line.removeprefix("# ") for line in lines if "_px = " in line and line.startswith("# ")]
    utc_start = next(line.removeprefix("# ") for line in lines if line.startswith("# utc_start"))

    config = Config.load(write("\n".join(["[camera]", *camera, "[flight]", utc_start])))

    assert config.camera() == Config().camera()
    assert config.flight.start_utc_s == 1710068400.0


def test_every_line_of_the_example_has_a_comment() -> None:
    lines = asset("glstar.toml").read_text(encoding="utf-8").splitlines()

    assert [line for line in lines if " = " in line and "#" not in line] == []
    assert max(map(len, lines)) <= 120


# --- nouns ------------------------------------------------------------------------------------------------------------


def test_degrees_become_radians(write: Write) -> None:
    config = Config.load(write('[mount]\nyaw_deg = 180\npitch_deg = -45.0\nroll_deg = 90\nreading = "literal"\n'))

    assert config.mount() == Mount(np.pi / 2, -np.pi / 4, np.pi, "literal")


def test_a_camera_in_numbers_has_its_principal_point_in_the_middle_by_default(write: Write) -> None:
    text = "[camera]\nwidth_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 501.5\n"

    assert Config.load(write(text)).camera() == Camera(640, 480, 500.0, 501.5, 319.5, 239.5)
    assert Config.load(write(text + "cx_px = 0\ncy_px = 3\nskew_px = 1\n")).camera() == Camera(
        640, 480, 500.0, 501.5, 0.0, 3.0, 1.0
    )


def test_a_camera_by_name(write: Write) -> None:
    assert Config.load(write('[camera]\npreset = "picam2"\n')).camera() == camera_from_preset("picam2")


def test_paths_in_a_config_are_relative_to_its_folder(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(CALIB, "rig/lens/calib.yaml")
    write("[sensor]\nbit_depth = 12\n", "rig/calibration.toml")
    write(
        '[camera]\nfile = "lens/calib.yaml"\n[sensor]\nfile = "calibration.toml"\n[sky]\ncatalogue = "stars.sqlite"\n',
        "rig/glstar.toml",
    )
    monkeypatch.chdir(tmp_path)

    config = Config.load("rig/glstar.toml")

    assert config.camera() == CALIB_CAMERA
    assert config.sensor() == Sensor(bit_depth=12)
    assert config.sky.catalogue == str(tmp_path / "rig" / "stars.sqlite")


def test_a_sensor_file_may_have_the_other_tables_of_a_calibration(write: Write) -> None:
    write("[sensor]\npsf_sigma_px = 2\n[mount]\nyaw_deg = 3\n[fit]\nstars = 100\n", "calibration.toml")

    config = Config.load(write('[sensor]\nfile = "calibration.toml"\n'))

    assert config.sensor() == Sensor(psf_sigma_px=2.0)
    assert config.mount() == Mount()


def test_sensor_and_camera_may_come_from_one_calibration(write: Write) -> None:
    numbers = "width_px = 640\nheight_px = 480\nfx_px = 700.0\nfy_px = 700.0\n"
    write(
        f'[sensor]\npsf_sigma_px = 2\n[camera]\n{numbers}lens = "plumb_bob"\ndistortion = [-0.1]\n', "calibration.toml"
    )

    config = Config.load(write('[sensor]\nfile = "calibration.toml"\n[camera]\nfile = "calibration.toml"\n'))

    assert config.sensor().psf_sigma_px == 2
    assert config.camera() == Camera(640, 480, 700.0, 700.0, 319.5, 239.5, lens=Lens("plumb_bob", (-0.1,)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[sensor]\n", "camera: is missing; a calibration in TOML has a [camera] section"),
        ('[camera]\npreset = "picamhq-6mm"\n', "camera: must hold the numbers, not file or preset"),
        ("[camera]\nwidth_px = 640\n", "camera.height_px: is missing from a camera given in numbers"),
        ("[camera]\nfx_px = -1\n", "camera.fx_px: must be a positive number of pixels"),
    ],
)
def test_a_calibration_without_a_camera_is_refused(write: Write, content: str, words: str) -> None:
    write(content, "calibration.toml")

    with pytest.raises(ConfigError) as caught:
        Config.load(write('[camera]\nfile = "calibration.toml"\n'))

    assert words in str(caught.value)
    assert "calibration.toml" in str(caught.value)


def test_a_resolved_config_is_a_sensor_file(write: Write) -> None:
    write(Config().override(**{"sensor.sky_mean_dn": 5}).to_toml(), "calibration.toml")

    assert Config.load(write('[sensor]\nfile = "calibration.toml"\n')).sensor() == Sensor(sky_mean_dn=5.0)


@pytest.mark.parametrize(
    "utc_start", ['"2024-03-10T11:00:00Z"', "2024-03-10T11:00:00Z", "2024-03-10T21:30:00+10:30", "2024-03-10T11:00:00"]
)
def test_a_start_time_is_read_with_or_without_quotes(write: Write, utc_start: str) -> None:
    assert Config.load(write(f"[flight]\nutc_start = {utc_start}\n")).flight.start_utc_s == 1710068400.0


def test_the_former_name_of_analytic_trails_is_read(write: Write) -> None:
    assert Config.load(write('[exposure]\ntrail = "swept"\n')).exposure.trail == "analytic"
    assert Config().override(**{"exposure.trail": "swept"}).exposure.trail == "analytic"


def test_a_byte_order_mark_and_windows_line_ends_are_accepted_in_a_config(tmp_path: Path) -> None:
    path = tmp_path / "glstar.toml"
    path.write_bytes(b"\xef\xbb\xbf[exposure]\r\nduration_s = 2\r\n")

    assert Config.load(path).exposure.duration_s == 2.0


def test_a_config_cannot_be_changed() -> None:
    config = Config()

    with pytest.raises(FrozenInstanceError):
        config.file = Path()
    with pytest.raises(ValueError, match="frozen"):
        config.exposure.duration_s = 1.0
    assert hash(config) == hash(Config())


# --- faults -----------------------------------------------------------------------------------------------------------


def test_all_validation_errors_are_reported_together(write: Write) -> None:
    path = write(
        """
        duration_s = 3
        [camra]
        width_px = 640
        [exposure]
        duraton_s = 1
        rate_hz = "200"
        yaw_deg = 3
        [sky]
        astrometry = "Erva"
        refraction = 1
        [camera]
        preset = "picamhq-6m"
        """
    )

    count, *faults = refusal(path).replace(" faults: ", " | ").split(" | ")

    assert faults == [
        "duration_s: is no section (it belongs in [exposure])",
        "camra: is no section (did you mean camera?)",
        'camera.preset: there is no camera "picamhq-6m" (did you mean "picamhq-6mm"? There are picamhq-6mm,'
        " picamhq-6mm-binned4, picamhq-16mm, picam2, and the sensors that glstar camera presets lists)",
        'exposure.rate_hz: must be a positive number of sub-exposures a second, not "200" (leave out the quotes)',
        "exposure.duraton_s: is no key of [exposure] (did you mean duration_s?)",
        "exposure.yaw_deg: is no key of [exposure] (it belongs in [mount])",
        'sky.astrometry: must be "paper" or "erfa", not "Erva" (did you mean "erfa"?)',
        "sky.refraction: must be true or false, not 1",
    ]
    assert int(count) == len(faults)


@pytest.mark.parametrize(
    ("section", "line", "words"),
    [
        ("exposure", "duration_s = 0", "must be a positive number of seconds, not 0"),
        ("exposure", "duration_s = -0.5", "must be a positive number of seconds, not -0.5"),
        ("exposure", "duration_s = nan", "must be a positive number of seconds, not nan"),
        ("exposure", "interval_s = inf", "must be a positive number of seconds, not inf"),
        ("exposure", "rate_hz = true", "must be a positive number of sub-exposures a second, not true"),
        ("exposure", "rate_hz = [200]", "must be a positive number of sub-exposures a second, not a list"),
        ("exposure", "rate_hz = {hz = 200}", "must be a positive number of sub-exposures a second, not a table"),
        ("exposure", "rate_hz = 1" + "0" * 400, "must be a positive number of sub-exposures a second, not a number"),
        ("camera", "width_px = 640.0", "must be a whole number of pixels, from 1 to 65535, not 640.0"),
        ("camera", "width_px = 0", "must be a whole number of pixels, from 1 to 65535, not 0"),
        ("camera", "fx_px = 0", "must be a positive number of pixels (focal length / pixel pitch), not 0"),
        ("camera", 'file = ""', 'must be the path of a calibration file, in quotes, not ""'),
        ("camera", "preset = 6", "must be the name of a camera or of a sensor's mode, in quotes, not 6"),
        ("mount", "pitch_deg = 2024-03-10", "must be a number of degrees, not 2024-03-10"),
        ("mount", 'reading = "bdy"', 'must be "body" or "literal", not "bdy" (did you mean "body"?)'),
        ("mount", "reading = 1", 'must be "body" or "literal", not 1'),
        ("sensor", "psf_sigma_px = 0", "must be a positive number of pixels, not 0"),
        ("sensor", "sky_std_dn = -1", "must be a number of DN, 0 or more, not -1"),
        ("sensor", "bit_depth = 17", "must be a whole number from 1 to 16, not 17"),
        ("sensor", "bit_depth = 8.5", "must be a whole number from 1 to 16, not 8.5"),
        ("sensor", 'pixel = "point"', 'must be "integrated" or "sampled", not "point"'),
        ("sky", 'catalogue = "bsc"', 'not "bsc" (did you mean "bsc5"?)'),
        ("sky", 'catalogue = "sao"', '"bsc5", "hipparcos", "tycho2", "gaia" or the path of a .sqlite file, not "sao"'),
        ("sky", "dut1_s = 37", "must be UT1 - UTC in seconds, from -1 to 1, not 37"),
        ("air", "pressure_hpa = 101325", "must be a number of hPa from 0 to 1200, not 101325"),
        ("air", "temperature_c = 283.15", "must be degrees Celsius, from -120 to 100, not 283.15"),
        ("flight", "attitude = 3", 'must be "auto" or the name of a message, such as "ATT", not 3'),
        ("flight", "latitude_deg = 91\nlongitude_deg = 0", "must be degrees north, from -90 to 90, not 91"),
        ("flight", "sysid = 0", "must be a whole number from 1 to 255, not 0"),
        ("flight", 'utc_start = "noon"', 'must be a time such as "2024-03-10T11:00:00Z", not "noon"'),
    ],
)
def test_an_invalid_value_is_reported_with_the_allowed_values(
    write: Write, section: str, line: str, words: str
) -> None:
    message = refusal(write(f"[{section}]\n{line}\n"))

    assert f"{section}.{line.split(' =', maxsplit=1)[0]}: " in message
    assert words in message


def test_a_single_validation_error_is_reported_with_its_key(write: Write) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load(write("[exposure]\nduration_s = -1\n"))

    assert caught.value.key == "exposure.duration_s"
    assert "faults" not in str(caught.value)


def test_the_key_of_an_error_is_that_of_the_first_validation_error(write: Write) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load(write("[exposure]\nduration_s = -1\n[air]\npressure_hpa = -1\n"))

    assert caught.value.key == "exposure.duration_s"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[exposure]\nduration_ms = 500\n", "exposure.duration_ms: is no key of [exposure] (did you mean duration_s?)"),
        (
            "[exposure]\nqq = 1\n",
            "exposure.qq: is no key of [exposure] (there are duration_s, at, at_delay_s, interval_s, rate_hz, trail,"
            " path_tolerance_px, faintest_dn, readout_s, readout, frames, gap_s, stack, control, control_target,"
            " control_percentile, control_min_s, control_min_gain, control_max_gain, control_delay_frames,"
            " control_speed)",
        ),
        ('[exposure]\n"a\\nb" = 1\n', 'exposure."a\\nb": is no key of [exposure]'),
        (
            "[zzz]\n",
            "zzz: is no section (there are camera, mount, exposure, sensor, sky, air, flight, ",
        ),
        ("[exposure.more]\nx = 1\n", "exposure.more: is no key of [exposure]"),
        ("mount = 3\n", "mount: must be a section, [mount] with keys below it, not 3"),
        ("[[mount]]\nyaw_deg = 3\n", "mount: must be a section, [mount] with keys below it, not a list"),
    ],
)
def test_the_message_for_an_unknown_key_has_a_suggestion(write: Write, text: str, words: str) -> None:
    assert words in refusal(write(text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('preset = "picam2"\nfile = "calib.yaml"', "camera: has file and preset; give a file, or a preset, or numbers"),
        ('preset = "picam2"\nfx_px = 3', "camera: has preset and fx_px; give a file, or a preset, or numbers"),
        ('preset = "imx477:2028x1520"\nfx_px = 3', '[sensor] preset = "imx477:2028x1520"'),
        ('file = "calib.yaml"\nskew_px = 0', "camera: has file and skew_px; give a file, or a preset, or numbers"),
    ],
)
def test_a_camera_has_one_source_only(write: Write, text: str, words: str) -> None:
    write(CALIB, "calib.yaml")

    assert words in refusal(write(f"[camera]\n{text}\n"))


def test_a_camera_in_numbers_must_have_all_required_keys(write: Write) -> None:
    message = refusal(write("[camera]\nwidth_px = 640\nfx_px = 500\n"))

    assert message == (
        "2 faults: camera.height_px: is missing from a camera given in numbers"
        " | camera.fy_px: is missing from a camera given in numbers"
    )


LENS_IN_NUMBERS = """
[camera]
width_px = 640
height_px = 480
fx_px = 500
fy_px = 500
lens = "plumb_bob"
distortion = [-0.28, 0.07, 1e-5, 0]
"""


def test_a_lens_in_numbers_is_written_and_read_back(write: Write) -> None:
    config = Config.load(write(LENS_IN_NUMBERS))

    assert config.camera().lens == Lens("plumb_bob", (-0.28, 0.07, 1e-5, 0.0))
    assert Config.load(write(config.to_toml(), "resolved.toml")).camera() == config.camera()


@pytest.mark.parametrize(
    ("given", "instead", "words"),
    [
        ('"plumb_bob"', '"plumbob"', 'or "eucm" or "omni", not "plumbob" (did you mean "plumb_bob"?)'),
        ('lens = "plumb_bob"\n', "", 'camera.lens: is missing beside distortion; it is "plumb_bob" or "rational" or'),
        ('"plumb_bob"', '"fisheye"', None),
        ("1e-5, 0]", "1e-5, 0, 0, 0]", "camera.distortion: 6 distortion coefficients are too many for plumb_bob: k1,"),
        ("1e-5, 0]", '"wide"]', "camera.distortion: must be a list of numbers, OpenCV's distortion coefficients"),
    ],
)
def test_an_invalid_lens_in_numbers_is_a_validation_error(
    write: Write, given: str, instead: str, words: str | None
) -> None:
    path = write(LENS_IN_NUMBERS.replace(given, instead))

    if words is None:
        lens = Config.load(path).camera().lens
        assert lens is not None
        assert lens.model == "fisheye"
    else:
        assert words in refusal(path)


def test_an_unusable_calibration_file_is_reported_with_the_other_errors(write: Write, tmp_path: Path) -> None:
    write(CALIB + "D: [0.1, wide, 0, 0]\n", "calib.yaml")

    message = refusal(write('[camera]\nfile = "calib.yaml"\n[air]\npressure_hpa = -1\n'))

    assert f"camera.file: {tmp_path / 'calib.yaml'}: D must be a number, not 'wide'" in message
    assert "air.pressure_hpa: must be" in message


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (None, "there is no such file"),
        ("[sensor\n", "line 1, column 8: "),
        ("[mount]\n", "sensor: is missing; a sensor calibration is a TOML file with a [sensor] section"),
        ("sensor = 3\n", "sensor: must be a section"),
        ("[sensor]\npsf_sigma_px = -1\n", "sensor.psf_sigma_px: must be a positive number of pixels, not -1"),
        ("[sensor]\nsigma_px = 1\n", "sensor.sigma_px: is no key of [sensor] (did you mean psf_sigma_px?)"),
        ('[sensor]\nfile = "calibration.toml"\n', "sensor.file: is not allowed in a calibration file"),
    ],
)
def test_an_unusable_sensor_file_is_refused(write: Write, tmp_path: Path, calibration: str | None, words: str) -> None:
    if calibration is not None:
        write(calibration, "calibration.toml")

    message = refusal(write('[sensor]\nfile = "calibration.toml"\n'))

    assert message.startswith(f"sensor.file: {tmp_path / 'calibration.toml'}: ")
    assert words in message


def test_a_sensor_is_given_by_a_file_or_by_numbers(write: Write) -> None:
    assert "sensor: has file and bit_depth" in refusal(write('[sensor]\nfile = "c.toml"\nbit_depth = 8\n'))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[exposure]\nduration_s 3\n", "line 2, column 12: Expected '=' after a key in a key/value pair (TOML)"),
        (b"[exposure]\nduration_s = 1\nduration_s = 2\n", "line 3, column "),
        (b"x = [" + b"[" * 5000, "is nested too deeply"),
        (b"x = 1" + b"0" * 5000, "Exceeds the limit"),
        (b"\xff\xfe[\x00", "is not UTF-8 text (byte 0xff at offset 0)"),
        (b"# caf\xe9\n", "is not UTF-8 text (byte 0xe9 at offset 5)"),
        (b"\xa3\x95\x80\x80FMT", "is not UTF-8 text"),
    ],
)
def test_a_file_that_is_not_toml_is_refused_in_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "glstar.toml"
    path.write_bytes(content)

    assert words in refusal(path)


def test_a_missing_file_and_a_directory_are_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "glstar.toml") == "there is no such file"
    assert refusal(tmp_path) == "this is a directory; give a file"


def test_a_flight_log_in_place_of_a_config_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.bin"
    with path.open("wb") as file:
        file.truncate(2**30)

    assert "is larger than 1 MiB" in refusal(path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(at=st.integers(0, 3500), new=st.binary(max_size=8))
def test_a_damaged_config_is_read_or_refused_in_one_line(tmp_path: Path, at: int, new: bytes) -> None:
    whole = asset("glstar.toml").read_bytes()
    path = tmp_path / "glstar.toml"
    path.write_bytes(whole[:at] + new + whole[at + len(new) :])

    try:
        Config.load(path)
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017


# --- flags ------------------------------------------------------------------------------------------------------------


def test_a_flag_overrides_the_config(write: Write) -> None:
    config = Config.load(write("[exposure]\nduration_s = 2\ninterval_s = 4\n"))

    changed = config.override(**{"exposure.duration_s": 1, "sky.astrometry": "erfa"})

    assert (changed.exposure.duration_s, changed.exposure.interval_s) == (1.0, 4.0)
    assert changed.sky.astrometry == "erfa"
    assert config.exposure.duration_s == 2.0


def test_a_flag_that_is_not_given_leaves_its_key_unchanged() -> None:
    assert Config().override(**{"exposure.duration_s": None, "sky.dut1_s": None}) == Config()


def test_flags_are_checked_like_the_file(write: Write) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load(write("[exposure]\n")).override(**{"exposure.duration_s": -1.0, "air.presure_hpa": 1000.0})

    # The file is without blame.
    assert caught.value.file is None
    assert str(caught.value) == (
        "2 faults: exposure.duration_s: must be a positive number of seconds, not -1.0"
        " | air.presure_hpa: is no key of [air] (did you mean pressure_hpa?)"
    )


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("exposre.duration_s", "exposre.duration_s: is no key (did you mean exposure.duration_s?)"),
        (
            "x",
            "x: is no key (the sections are camera, mount, exposure, sensor, sky, air, flight, ",
        ),
        ("exposure.", "exposure.: is no key"),
        ("exposure.duration_s.x", "exposure.duration_s.x: is no key of [exposure] (did you mean duration_s?)"),
    ],
)
def test_the_message_for_an_unknown_flag_has_a_suggestion(key: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Config().override(**{key: 1})

    assert words in str(caught.value)


def test_another_camera_replaces_the_one_in_the_config(write: Write) -> None:
    numbers = Config.load(write("[camera]\nwidth_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500\n"))

    assert numbers.override(**{"camera.preset": "picam2"}).camera() == camera_from_preset("picam2")
    assert numbers.override(**{"camera.file": write(CALIB, "calib.yaml")}).camera() == CALIB_CAMERA
    assert numbers.override(**{"camera.fx_px": 600.0}).camera().fx_px == 600.0


def test_a_path_on_the_command_line_is_relative_to_the_working_directory(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = Config.load(write("[exposure]\n", "rig/glstar.toml"))
    write(CALIB, "calib.yaml")
    monkeypatch.chdir(tmp_path)

    changed = config.override(**{"camera.file": "calib.yaml", "sky.catalogue": "stars.sqlite"})

    assert changed.camera() == CALIB_CAMERA
    assert changed.sky.catalogue == str(tmp_path / "stars.sqlite")


def test_a_flag_of_the_sensor_overrides_its_file(write: Write) -> None:
    write("[sensor]\nbit_depth = 12\npsf_sigma_px = 2\n", "calibration.toml")
    config = Config.load(write('[sensor]\nfile = "calibration.toml"\n'))

    assert config.override(**{"sensor.psf_sigma_px": 3.0}).sensor() == Sensor(bit_depth=12, psf_sigma_px=3.0)


def test_a_config_can_be_overridden_twice() -> None:
    config = Config().override(**{"exposure.duration_s": 1.0}).override(**{"exposure.interval_s": 2.0})

    assert (config.exposure.duration_s, config.exposure.interval_s) == (1.0, 2.0)


# --- resolved ---------------------------------------------------------------------------------------------------------


def test_a_resolved_config_has_every_value(write: Write) -> None:
    write(CALIB, "calib.yaml")
    write("[sensor]\nbit_depth = 12\n", "calibration.toml")

    resolved = Config.load(write('[camera]\nfile = "calib.yaml"\n[sensor]\nfile = "calibration.toml"\n')).resolved()

    assert json.loads(json.dumps(resolved)) == resolved
    assert resolved["camera"] == {
        "width_px": 640,
        "height_px": 480,
        "fx_px": 500.0,
        "fy_px": 501.0,
        "cx_px": 320.0,
        "cy_px": 240.0,
        "skew_px": 0.5,
        "file": "calib.yaml",
    }
    assert resolved["sensor"]["bit_depth"] == 12
    assert resolved["sensor"]["file"] == "calibration.toml"
    of_the_paper = [effect for effect in EFFECTS if effect.noise_model != "electrons"]
    of_effects = {key.name for effect in of_the_paper if effect.section == "sensor" for key in effect.keys}
    assert set(resolved["sensor"]) == Sensor().keys.keys() | of_effects | {"file"}
    limits = {"gimbal_roll_limit_deg": 180.0, "gimbal_pitch_limit_deg": 90.0}
    gimbal = {"gimbal": "none", **limits, "gimbal_lag_s": 0.0, "gimbal_heading_lag_s": 0.0}
    assert resolved["mount"] == {"yaw_deg": -90.0, "pitch_deg": 90.0, "roll_deg": 0.0, "reading": "body", **gimbal}


def test_a_resolved_config_names_its_preset() -> None:
    assert Config().resolved()["camera"]["preset"] == "picamhq-6mm-binned4"
    assert Config().override(**{"camera.preset": "picam2"}).resolved()["camera"]["preset"] == "picam2"


def test_a_config_written_to_toml_loads_to_an_equal_one_in_another_folder(write: Write) -> None:
    write(CALIB, "rig/calib.yaml")
    write("[sensor]\nbit_depth = 12\n", "rig/calibration.toml")
    text = """
        [camera]
        file = "calib.yaml"
        [sensor]
        file = "calibration.toml"
        [sky]
        catalogue = "stars.sqlite"
        refraction = false
        [flight]
        utc_start = "2024-03-10T11:00:00Z"
        """
    config = Config.load(write(text, "rig/glstar.toml"))

    again = Config.load(write(config.to_toml(), "elsewhere/glstar.toml"))

    assert again.sensor() == config.sensor()
    assert again.camera() == config.camera()
    assert again.sky == config.sky
    assert again.flight == config.flight
    assert again == config


finite = {"allow_nan": False, "allow_infinity": False}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    duration_s=st.floats(min_value=0, exclude_min=True, **finite),
    yaw_deg=st.floats(**finite),
    attitude=st.text(st.characters(codec="utf-8"), min_size=1),
    vmag_limit=st.integers(-5, 15),
)
def test_any_config_written_to_toml_loads_to_an_equal_one(
    tmp_path: Path, duration_s: float, yaw_deg: float, attitude: str, vmag_limit: int
) -> None:
    config = Config().override(
        **{
            "exposure.duration_s": duration_s,
            "mount.yaw_deg": yaw_deg,
            "flight.attitude": attitude,
            "sky.vmag_limit": vmag_limit,
        }
    )
    path = tmp_path / "glstar.toml"
    path.write_text(config.to_toml(), encoding="utf-8", newline="")

    assert Config.load(path) == config


# --- the place of a log that has none ---------------------------------------------------------------------------------


def test_a_site_is_given_in_degrees(write: Write) -> None:
    text = "[flight]\nlatitude_deg = -34.93\nlongitude_deg = 138.6\n"

    site = Config.load(write(text + "height_m = 48\n")).flight.site

    assert site is not None
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.93, 138.6])
    assert site.height_m == 48.0
    assert (
        Config.load(write(text)).flight.site
        == Config()
        .override(**{"flight.latitude_deg": -34.93, "flight.longitude_deg": 138.6, "flight.height_m": 0.0})
        .flight.site
    )
    assert Config().flight.site is None


@pytest.mark.parametrize(
    ("text", "missing"),
    [("latitude_deg = 1.0", "longitude_deg"), ("longitude_deg = 1.0\nheight_m = 3", "latitude_deg")],
)
def test_a_latitude_without_a_longitude_is_refused(write: Write, text: str, missing: str) -> None:
    message = refusal(write(f"[flight]\n{text}\n"))

    assert message == f"flight.{missing}: is missing from a place given in numbers"


def test_a_height_without_latitude_and_longitude_is_refused(write: Write) -> None:
    assert "flight.latitude_deg" in refusal(write("[flight]\nheight_m = 3\n"))


# --- hygiene ----------------------------------------------------------------------------------------------------------


def test_importing_the_config_loads_neither_opencv_nor_opengl_nor_mavlink_nor_astropy() -> None:
    program = (
        "import sys, glstar.config;"
        "print(*sorted({'cv2', 'moderngl', 'pymavlink', 'astropy', 'glfw'} & set(sys.modules)))"
    )

    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert loaded.stdout.split() == []


def test_the_interpolation_of_the_attitude_is_one_of_three(tmp_path: Path) -> None:
    path = tmp_path / "smooth.toml"
    path.write_text('[flight]\ninterpolation = "spline"\n')
    assert Config.load(path).flight.interpolation == "spline"
    assert "between samples by a spline" in Config.load(path).open_flight(asset("adelaide.BIN")).attitude_source
    path.write_text('[flight]\ninterpolation = "cubic"\n')
    with pytest.raises(ConfigError, match="interpolation"):
        Config.load(path)
    path.write_text('[flight]\ninterpolation = "gyro"\n')
    with pytest.raises(LogFormatError, match='take "spline"'):
        Config.load(path).open_flight(asset("adelaide.BIN"))


def test_the_settings_beside_a_saved_live_flight_keep_the_camera_s_clock():
    live = Config().override(**{"flight.sysid": 3, "flight.max_gap_s": 0.5, "flight.utc_start": "2024-03-10T11:00:00Z"})

    beside = live.for_a_table(time_offset_s=0.25).flight

    assert (beside.time_offset_s, beside.max_gap_s, beside.sysid, beside.utc_start) == (0.25, 0.5, None, None)


def test_the_preset_full_adds_what_natural_leaves_out(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text('[sky]\npreset = "full"\ngalaxy = false\n', encoding="utf-8")
    sky = Config.load(path).sky
    assert (sky.bodies, sky.extinction, sky.brightness, sky.horizon) == (True, "standard", "natural", "dip")
    assert (sky.zodiacal_light, sky.galaxy, sky.extinction_band, sky.scintillation) == (True, False, "sensor", 0.38)
    path.write_text('[sky]\npreset = "natural"\n', encoding="utf-8")
    natural = Config.load(path).sky
    assert (natural.zodiacal_light, natural.galaxy, natural.extinction_band, natural.scintillation) == (
        *(False, False),
        *("eye", 0.0),
    )
