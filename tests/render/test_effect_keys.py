"""Keys of the effects: limits as their descriptions say, defaults, and the sliders of the viewer's settings panel."""

import re

import numpy as np

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.effects import EFFECTS, Control, Effect, Key, Stage, light_keys, scaled_keys

KEYS = {effect.dotted(key): key for effect in EFFECTS for key in effect.keys}
NUMBER = r"-?\d+(?:\.\d+)?"

# Lowest, highest, form with the unit, and whether the slider is logarithmic.
SLIDERS = {
    "sensor.sky_mean_dn": (0, 4096, "%.1f DN", True),
    "sensor.sky_std_dn": (0, 1024, "%.2f DN", True),
    "sensor.dead_pixels_per_mpx": (0, 1000, "%.0f /Mpx", True),
    "sensor.prnu_fraction": (0, 0.1, "%.4f", False),
    "sensor.dark_current_e_per_s": (0, 100, "%.2f e/s at 25 C", True),
    "sensor.temperature_c": (-20, 80, "%.1f C", False),
    "sensor.hot_pixels_per_mpx": (0, 10_000, "%.0f /Mpx", True),
    "sensor.dsnu_fraction": (0, 1, "%.3f", False),
    "sensor.blooming_fraction": (0, 1, "%.3g", False),
    "sensor.full_well_e": (100, 200_000, "%.0f e", True),
    "sensor.read_noise_before_gain_e": (0, 50, "%.2f e", True),
    "sensor.read_noise_after_gain_e": (0, 50, "%.2f e", True),
    "sensor.gain_dn_per_e": (0.001, 100, "%.4f DN/e", True),
    "sensor.analogue_gain": (1, 64, "x %.2f", True),
    "sensor.row_noise_e": (0, 10, "%.2f e", True),
    "sensor.black_drift_dn": (0, 16, "%.2f DN", True),
    "sensor.black_level_dn": (0, 4096, "%.1f DN", True),
    "sensor.bit_depth": (1, 16, "%.3g", False),
    "sensor.psf_beta": (2, 8, "%.2f", False),
    "sensor.psf_wing_fraction": (0, 0.5, "%.3f of the flux", False),
    "sensor.psf_wing_sigma_px": (1, 20, "%.2f px", False),
    "sensor.psf_halo_fraction": (0, 0.1, "%.4f of the flux", False),
    "sensor.psf_halo_radius_px": (1, 40, "%.1f px", False),
    "sensor.psf_growth": (0, 2, "%.3f", False),
    "sensor.psf_ellipticity": (0, 0.4, "%.3f", False),
    "sensor.psf_angle_deg": (-90, 90, "%.0f deg", False),
    "sensor.psf_tilt": (0, 0.9, "%.3f", False),
    "sensor.psf_tilt_angle_deg": (-180, 180, "%.0f deg", False),
    "sensor.psf_colour_growth": (-0.5, 0.5, "%.3f", False),
    "sky.zenith_mag_arcsec2": (16, 23, "V %.2f", False),
    "sky.town_mag_arcsec2": (16, 30, "V %.2f", False),
    "sky.scintillation": (0, 0.76, "%.2f", False),
    "cloud.coverage": (0, 1, "%.2f", False),
    "cloud.optical_depth": (0, 5, "%.2f", False),
    "cloud.height_m": (0, 12_000, "%.0f m", False),
    "cloud.scale_m": (100, 10_000, "%.0f m", True),
    "cloud.wind_m_s": (0, 60, "%.0f m/s", False),
    "flare.scatter": (0, 0.05, "%.4f", False),
    "flare.ghost_fraction": (0, 0.002, "%.5f", False),
    "flare.streak_fraction": (0, 0.005, "%.5f", False),
}

DEFAULTS = {
    "sensor": {
        "sky_mean_dn": 16, "sky_std_dn": 3, "sky_map": "", "dead_pixels_per_mpx": 0, "prnu_fraction": 0,
        "flat_field": "", "defect_map": "", "dark_current_e_per_s": 0.2, "dark_doubling_c": 7, "temperature_c": 25,
        "camera_seed": 0, "hot_pixels_per_mpx": 0, "stuck_fraction": 0.4, "dsnu_fraction": 0, "dark_frame": "",
        "blooming": "none", "blooming_fraction": 1, "full_well_e": 8200, "read_noise_before_gain_e": 1.5,
        "read_noise_after_gain_e": 2.8, "gain_dn_per_e": 0.47, "analogue_gain": 1, "row_noise_e": 0,
        "black_drift_dn": 0, "black_level_dn": 256, "bit_depth": 8, "psf": "gaussian", "psf_beta": 3,
        "psf_wing_fraction": 0, "psf_wing_sigma_px": 4, "psf_halo_fraction": 0, "psf_halo_radius_px": 20,
        "psf_growth": 0, "psf_ellipticity": 0, "psf_angle_deg": 0, "psf_tilt": 0, "psf_tilt_angle_deg": 0,
        "psf_colour_growth": 0, "band": "v", "band_slope": 0, "band_curvature": 0, "mosaic": "none", "sky_bv": 0.9,
    },
    "lens": {
        "vignetting": "none", "vignetting_r2": 0, "vignetting_r4": 0, "vignetting_r6": 0, "vignetting_file": "",
    },
    "sky": {
        "brightness": "flat", "zenith_mag_arcsec2": 21.6, "moonlight": True, "twilight": True,
        "zodiacal_light": False, "galaxy": False, "town_mag_arcsec2": 30, "town_azimuth_deg": -1,
        "ground_fraction": 0.1, "scintillation": 0, "scintillation_seed": 0,
    },
    "cloud": {
        "coverage": 0, "optical_depth": 2, "height_m": 4000, "scale_m": 2000, "edge": 1, "wind_m_s": 10,
        "wind_from_deg": 270, "seed": 0,
    },
    "flare": {
        "scatter": 0, "scatter_deg": 0.5, "hood_deg": 90, "ghost_fraction": 0, "ghosts": 4, "ghost_size": 0.15,
        "ghost_seed": 0, "streak_fraction": 0, "streak_deg": 0, "lamp_mag": 30, "lamp_azimuth_deg": 0,
        "lamp_altitude_deg": 0,
    },
    "output": {
        "process": "raw", "subtract_black": True, "defect_correction": False, "defect_ratio": 1.5,
        "defect_threshold": 0.01, "demosaic": "none", "red_gain": 3.2, "blue_gain": 1.4, "colour_matrix": "none",
        "denoise": 0, "gamma": "linear", "tone_curve": "", "channel": "rgb", "align": "low", "jpeg_quality": 93,
    },
}  # fmt: skip


def described_limits(key: Key) -> tuple[float | None, float | None, float | None]:
    """Return minimum, maximum and the number to exceed, as the description of a number says."""
    if isinstance(key.default, (bool, str)) and not key.or_number:
        return None, None, None
    if found := re.search(rf"({NUMBER}) to ({NUMBER})", key.allowed):
        return float(found[1]), float(found[2]), None
    if "0 or more" in key.allowed:
        return 0.0, None, None
    if "positive" in key.allowed:
        return None, None, 0.0
    found = re.search(rf"up to ({NUMBER})", key.allowed)
    return None, float(found[1]) if found else None, None


def test_a_key_has_the_limits_of_its_description() -> None:
    for name, key in KEYS.items():
        assert (key.minimum, key.maximum, key.above) == described_limits(key), name
        assert key.or_number == ("or a number" in key.allowed), name
        assert key.or_points == ("a list of [" in key.allowed), name
        quoted = re.findall(r"""["'](\w+)["']""", key.allowed)
        listed = re.findall(r"\w+", key.allowed.removeprefix("one of "))
        is_choice = isinstance(key.default, str) and "path" not in key.allowed and not key.or_points
        assert list(key.choices) == ((quoted or listed) if is_choice else []), name


def test_keys_have_their_defaults() -> None:
    assert {name: key.default for name, key in KEYS.items()} == {
        f"{section}.{name}": default for section, keys in DEFAULTS.items() for name, default in keys.items()
    }
    for name, key in KEYS.items():
        section, short = name.split(".")
        assert isinstance(key.default, str | bool) == isinstance(DEFAULTS[section][short], str | bool)
        whole = key.allowed.startswith("a whole number")
        assert whole == (type(key.default) is int)


def test_numbers_have_sliders_and_choices_have_lists() -> None:
    sliders = {
        name: (key.control.lowest, key.control.highest, key.control.form, key.control.logarithmic)
        for name, key in KEYS.items()
        if key.control is not None and not isinstance(key.default, (bool, str))
    }
    assert sliders.keys() == SLIDERS.keys()
    for name, (lowest, highest, form, logarithmic) in sliders.items():
        np.testing.assert_allclose((lowest, highest), SLIDERS[name][:2], rtol=1e-12, atol=0, err_msg=name)
        assert (form, logarithmic) == SLIDERS[name][2:]
    plain = [key.control for key in KEYS.values() if key.control and isinstance(key.default, (bool, str))]
    assert {(c.lowest, c.highest, c.form, c.logarithmic) for c in plain} == {(0.0, 1.0, "%.3g", False)}


def test_stages_come_in_the_order_of_the_light() -> None:
    order = "STARS SKY_RADIANCE TRANSMISSION SKY FIXED_PATTERN DARK_CURRENT SHOT_NOISE FULL_WELL NOISE QUANTISATION"
    assert [stage.name for stage in sorted(Stage)] == [*order.split(), "PROCESSING"]
    light, dark = {"uniform_sky", "response_pattern", "full_pixels", "shot_noise"}, {"dark_current", "dark_pattern"}
    of_electrons = light | dark | {"blooming", "full_well", "row_noise", "black_level"}
    assert {effect.name for effect in EFFECTS if effect.noise_model == "electrons"} == of_electrons
    assert [effect.name for effect in EFFECTS if effect.noise_model == "paper"] == ["sky_level", "noise"]


def test_keys_of_light_and_of_digital_numbers_are_known() -> None:
    stars = {f"cloud.{name}" for name in DEFAULTS["cloud"]}
    stars |= {f"sensor.{name}" for name in DEFAULTS["sensor"] if name.startswith(("psf", "band"))}
    assert light_keys() == stars | {"sensor.mosaic"}
    assert scaled_keys() == {
        f"sensor.{name}" for name in ("sky_mean_dn", "sky_std_dn", "black_level_dn", "black_drift_dn")
    }


def test_a_key_and_an_effect_are_plain_by_default() -> None:
    assert Control("Gain") == Control("Gain", 0.0, 1.0, "%.3g", logarithmic=False)
    key = Key("gain", 2.5, "a number")
    assert key == Key("gain", 2.5, "a number", None, None, None, None, (), False, False, False, False)
    effect = Effect("gain", "own", (key, Key("mode", "fast", "a word")), Stage.NOISE, "")
    values = {"gain": 2.5, "mode": "fast"}
    assert effect.uniforms(values, None) == {"gain": 2.5}
    assert (effect.textures, effect.truth(values, None), effect.is_active(values)) == ((), {}, True)
    assert (effect.noise_model, effect.reads, effect.options(values, None)) == (None, (), {})
    assert (effect.only_at, effect.transfer, effect.dotted(key)) == (None, None, "own.gain")


def test_values_come_from_the_sensor_only_in_its_section() -> None:
    keys = (Key("psf_sigma_px", 9.0, "a number"), Key("full_well_e", 8.0, "a number"), Key("other", 7.0, "a number"))
    sensor = Sensor(
        psf_sigma_px=1.5, bit_depth=12, electrons=ElectronModel(full_well_e=555.0), effects={"own.other": 6.0}
    )
    own = Effect("own", "own", keys[:2], Stage.SKY, "", reads=keys[2:])
    assert own.values(sensor) == {"psf_sigma_px": 9.0, "full_well_e": 8.0, "other": 6.0}
    of_sensor = Effect("own", "sensor", keys, Stage.SKY, "")
    assert of_sensor.values(sensor) == {"psf_sigma_px": 1.5, "full_well_e": 555.0, "other": 7.0}
    assert of_sensor.values(Sensor())["full_well_e"] == 8.0
