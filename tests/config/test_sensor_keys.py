"""The keys of the electron model: presets, what follows from the lens, and what contradicts."""

from pathlib import Path

import pytest

from glstar.config import Config
from glstar.config.sensor import zero_point_e_per_s
from glstar.errors import ConfigError

HQ = {
    "camera.preset": "imx477:2028x1520",
    "camera.lens_mm": 6.0,
    "camera.f_number": 1.2,
    "sensor.preset": "imx477:2028x1520",
}


def test_without_its_keys_the_sensor_is_the_paper_s() -> None:
    assert Config().sensor().electrons is None
    assert not {"noise", "gain_dn_per_e", "vmag_0_e_per_s"} & Config().resolved()["sensor"].keys()


def test_a_preset_and_a_lens_are_enough() -> None:
    sensor = Config().override(**HQ).sensor()

    assert sensor.noise == "electrons"
    assert sensor.bit_depth == 12
    # 8.0e5 photons/s/cm2 through an aperture of 5 mm, a transmission of 0.8 and a quantum efficiency of 0.75.
    assert sensor.electrons.vmag_0_e_per_s == pytest.approx(8.0e5 * 0.19635 * 0.8 * 0.75, rel=1e-4)
    # 21 mag/arcsec^2 over the 106.57 arcsec wide pixels: 10.86 mag a pixel.
    assert sensor.electrons.sky_e_per_s == pytest.approx(94247.8 * 10 ** (-0.4 * 10.8617), rel=1e-3)


def test_given_numbers_replace_those_of_the_preset() -> None:
    sensor = Config().override(**HQ, **{"sensor.full_well_e": 20000.0, "sensor.sky_e_per_s": 2.0}).sensor()

    assert sensor.electrons.full_well_e == 20000.0
    assert sensor.electrons.sky_e_per_s == 2.0
    assert sensor.electrons.black_level_dn == 256.3


def test_the_zero_point_is_photons_times_area_times_transmission_times_efficiency() -> None:
    assert zero_point_e_per_s(20.0, 0.5, 0.5, 1e6) == pytest.approx(1e6 * 3.14159265 * 0.25, rel=1e-8)


def test_a_config_of_electrons_is_written_and_read_back(tmp_path: Path) -> None:
    config = Config().override(**HQ, **{"sensor.analogue_gain": 16.0, "sensor.temperature_c": 40.0})
    (tmp_path / "night.toml").write_text(config.to_toml())

    again = Config.load(tmp_path / "night.toml")

    assert again.sensor() == config.sensor()
    assert again.camera() == config.camera()


def test_the_noise_model_can_be_changed_and_changed_back() -> None:
    paper = Config().override(**{"sensor.sky_mean_dn": 20.0, "sensor.psf_sigma_px": 1.5})
    electrons = paper.override(**{"sensor.noise": "electrons", "sensor.analogue_gain": 4.0})
    again = electrons.override(**{"sensor.noise": "paper"})

    assert electrons.sensor().electrons.analogue_gain == 4.0
    assert electrons.sensor().psf_sigma_px == 1.5
    assert again.sensor().electrons is None
    assert again.sensor().bit_depth == 8
    assert again.sensor().psf_sigma_px == 1.5
    assert electrons.override(**{"sensor.preset": "generic"}).sensor().electrons.analogue_gain == 1.0


def test_the_keys_of_a_sensor_can_vary(tmp_path: Path) -> None:
    file = tmp_path / "sweep.toml"
    file.write_text(
        '[sensor]\nnoise = "electrons"\n[sweep]\ndraws = 3\nsensor.temperature_c = [10.0, 50.0]\n'
        "sensor.analogue_gain = { min = 1.0, max = 16.0, log = true }\n"
    )
    config = Config.load(file)

    samples = [config.at(config.sweep.sample(n)).sensor().electrons for n in range(len(config.sweep))]

    assert len(samples) == 6
    assert {sample.temperature_c for sample in samples} == {10.0, 50.0}
    assert all(1 <= sample.analogue_gain <= 16 for sample in samples)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"gain_dn_per_e": 1.0},
            'sensor.gain_dn_per_e: belongs to noise = "electrons" and the sensor has noise = "paper"',
        ),
        (
            {"noise": "electrons", "sky_std_dn": 1.0},
            'sensor.sky_std_dn: belongs to noise = "paper" and the sensor has noise = "electrons"',
        ),
        (
            {"preset": "imx477", "sky_mean_dn": 1.0},
            'sensor.sky_mean_dn: belongs to noise = "paper" and the sensor has noise = "electrons"',
        ),
        ({"noise": "electrons", "vmag_0_e_per_s": 1e5, "aperture_mm": 5.0}, "sensor.aperture_mm: is given beside"),
        (
            {"noise": "electrons", "sky_e_per_s": 1.0, "sky_mag_per_arcsec2": 20.0},
            "sensor.sky_e_per_s: is given beside sky_mag_per_arcsec2; give one of them",
        ),
        ({"preset": "imx477"}, "sensor.preset: imx477:4056x3040 has 4056 x 3040 px and the camera 1014 x 760"),
        ({"preset": "imx4"}, 'sensor.preset: there is no sensor "imx4"'),
        ({"noise": "electrons", "bit_depth": 8}, "sensor.black_level_dn: must be below the saturation of 8 bits"),
        ({"noise": "photons"}, 'sensor.noise: must be "paper" or "electrons", not "photons"'),
        ({"noise": "electrons", "full_well_e": 0.0}, "sensor.full_well_e: must be a positive number of electrons"),
    ],
)
def test_keys_that_contradict_each_other_are_refused(tmp_path: Path, keys: dict[str, object], message: str) -> None:
    lines = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in keys.items()]
    file = tmp_path / "wrong.toml"
    file.write_text("\n".join(["[sensor]", *lines, ""]))

    with pytest.raises(ConfigError) as refused:
        Config.load(file)

    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"camera.preset": "imx477"},
            "camera.lens_mm: is missing: the focal length of the lens before imx477:4056x3040",
        ),
        ({"camera.lens_mm": 6.0}, "camera.lens_mm: belongs to the preset of a sensor"),
        ({"camera.f_number": 2.0}, "camera.f_number: needs lens_mm"),
        ({**HQ, "sensor.aperture_mm": 5.0}, "sensor.aperture_mm: is given beside camera.f_number"),
        ({**HQ, "camera.preset": "imx477:9x9"}, "camera.preset: the sensor imx477 has no mode"),
    ],
)
def test_a_lens_belongs_to_a_sensor(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        Config().override(**keys)

    assert message in str(refused.value)


def test_the_mode_of_a_sensor_brings_its_readout_time() -> None:
    assert Config().override(**HQ).exposure.readout_s == pytest.approx(0.02305, rel=1e-12)
    assert Config().override(**HQ, **{"exposure.readout_s": 0.0}).exposure.readout_s == 0.0
    assert Config().override(
        **{"camera.preset": "imx477:4056x3040", "camera.lens_mm": 6.0}
    ).exposure.readout_s == pytest.approx(0.08686)
    assert Config().override(**{"camera.preset": "imx296", "camera.lens_mm": 6.0}).exposure.readout_s == 0.0
    assert Config().exposure.readout_s == 0.0
