"""``nav.jsonl``: what an aircraft knows, and nothing of the truth."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from astropy.io import fits
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from glstar.camera.exposure import Exposure
from glstar.cli import app
from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.imagefiles.fits import damage_of_fits
from glstar.export.navigator import LiveNavigator, Navigator, blind_phase_s, refuse_other_files
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.link.history import Estimate
from glstar.rotation import matrix_from_quaternion, turn_between
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from tests.support.exports import in_folder

CONFIG = """
[camera]
width_px = 64
height_px = 48
fx_px = 60.0
fy_px = 60.0

[exposure]
interval_s = 8.0

[flight.synthetic]
path = "orbit"
radius_m = 200
gusts = "light"
seed = 7919

[navigator]
roll_bias_deg = 0.25
drift_sigma_deg = 0.15
drift_time_s = 40.0
perlin_deg = 0.05
mount_pitch_error_deg = 0.4
clock_offset_s = 0.01
seed = 104729
"""


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def blind_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("blind")
    (folder / "nav.toml").write_text(CONFIG, encoding="utf-8")
    exported = in_folder(folder, "export", "-c", "nav.toml", "-o", "seen", "--blind", "hidden")
    assert exported.rc == 0, exported.err
    return folder


def test_a_navigator_sees_images_and_its_record_only(blind_set: Path) -> None:
    names = {path.name for path in (blind_set / "seen").iterdir()}
    truth = lines_of(blind_set / "hidden" / "truth.jsonl")

    assert names == {"nav.jsonl", *(frame["file"] for frame in truth)}
    for frame in truth:
        seen, hidden = ((blind_set / where / frame["file"]).read_bytes() for where in ("seen", "hidden"))
        assert seen == hidden


def test_a_record_has_the_listed_keys_and_no_seed_name_or_number_of_the_truth(blind_set: Path) -> None:
    text = (blind_set / "seen" / "nav.jsonl").read_text(encoding="utf-8")
    truth = lines_of(blind_set / "hidden" / "truth.jsonl")

    for record, frame in zip(lines_of(blind_set / "seen" / "nav.jsonl"), truth, strict=True):
        assert record.keys() == {
            *("schema", "frame", "file", "utc", "duration_s", "readout_s", "readout", "q_body_ned"),
            *("rates_rad_per_s", "up_camera", "C_camera_body", "camera", "position", "conventions"),
        }
        assert record["position"] is None
        assert record["camera"] == frame["camera"]
        for secret in (*frame["q_body_ned"], *np.ravel(frame["C_camera_body"]), *frame["up_camera"]):
            assert secret == 0 or repr(secret) not in text
        for secret in (frame["utc_start"], frame["utc_mid"], str(frame["seed"]), repr(frame["site"]["latitude_deg"])):
            assert secret not in text
    for secret in ("7919", "104729", "fly:", "orbit", "seed", "adelaide"):
        assert secret not in text


def test_png_images_hold_pixels_only(blind_set: Path) -> None:
    for path in (blind_set / "seen").glob("*.png"):
        content, at, kinds = path.read_bytes(), 8, set()
        while at < len(content):
            length, kind = int.from_bytes(content[at : at + 4]), content[at + 4 : at + 8]
            kinds.add(kind)
            at += 12 + length
        assert kinds == {b"IHDR", b"IDAT", b"IEND"}


def test_fits_images_for_a_navigator_have_no_coordinates_site_or_seed(blind_set: Path) -> None:
    words = ("-c", "nav.toml", "-o", "seen_fits", "--blind", "hidden_fits", "--format", "fits", "--frames", "2")
    exported = in_folder(blind_set, "export", *words)
    assert exported.rc == 0, exported.err

    nav, truth = (lines_of(blind_set / path) for path in ("seen_fits/nav.jsonl", "hidden_fits/truth.jsonl"))
    for known, drawn in zip(nav, truth, strict=True):
        seen, hidden = blind_set / "seen_fits" / known["file"], blind_set / "hidden_fits" / drawn["file"]
        # A wrong checksum is a warning, hence an error.
        with fits.open(seen, checksum=True) as one, fits.open(hidden, checksum=True) as other:
            np.testing.assert_array_equal(one[0].data, other[0].data)
            assert other[0].header["CTYPE1"].startswith("RA---")
            keys = set(one[0].header)
            times = [one[0].header[f"DATE-{name}"] for name in ("OBS", "AVG", "END")]
        assert not {key for key in keys if re.match("C(TYPE|RPIX|RVAL|D)|AP?_|BP?_|WCS|SITE|SEED|MJD|CLK|SKY", key)}
        assert times == [utc.removesuffix("Z") for utc in known["utc"].values()]
        content = seen.read_bytes()
        assert damage_of_fits(content, len(content)) == ""
        for secret in (drawn["utc_start"], drawn["utc_mid"], str(drawn["seed"]), repr(drawn["site"]["latitude_deg"])):
            assert secret.removesuffix("Z").encode() not in content


@pytest.mark.parametrize("format_", ["png16", "tiff", "jpeg"])
def test_images_of_each_format_state_neither_time_nor_place_nor_seed(format_: str, blind_set: Path) -> None:
    seen, hidden = f"seen_{format_}", f"hidden_{format_}"
    words = ("-c", "nav.toml", "-o", seen, "--blind", hidden, "--format", format_, "--frames", "1", "--seed", "990007")
    exported = in_folder(blind_set, "export", *words)
    assert exported.rc == 0, exported.err

    (drawn,) = lines_of(blind_set / hidden / "truth.jsonl")
    image = blind_set / seen / drawn["file"]
    content = image.read_bytes()
    utc = drawn["utc_start"]
    for secret in (utc[:10], utc[:10].replace("-", ":"), utc[11:19], str(drawn["seed"]), "990007", "Exif", "GPS"):
        assert secret.encode() not in content
    if format_ == "tiff":
        with tifffile.TiffFile(image) as file:
            names = {tag.name for tag in file.pages[0].tags.values()}
        assert not names & {"DateTime", "GPSTag", "ExifTag", "ImageDescription", "HostComputer", "Artist"}


def test_a_fraction_of_a_second_hides_the_error_of_the_clock(blind_set: Path) -> None:
    """The flight begins at a whole second and frames follow every 8 s: without a phase the records would show 10 ms."""
    truth = lines_of(blind_set / "hidden" / "truth.jsonl")
    fractions_s = {round(parse_utc(frame["utc_start"]) % 1, 6) for frame in truth}
    expected_s = float(np.random.default_rng([104729, 1 << 32]).uniform())
    assert fractions_s == {round(expected_s, 6)}

    command = json.loads((blind_set / "hidden" / "manifest.json").read_text())["command"]
    assert f"--start {round(expected_s, 6)}" in command


@pytest.mark.parametrize(
    ("changed", "phase_s"),
    [
        ({"navigator.clock_offset_s": 0.0}, 0.0),
        ({"exposure.at": "camera"}, 0.0),
        ({"navigator.seed": 3}, round(float(np.random.default_rng([3, 1 << 32]).uniform()), 6)),
    ],
)
def test_only_a_wrong_clock_moves_the_exposures(changed: dict[str, Any], phase_s: float, tmp_path: Path) -> None:
    (tmp_path / "nav.toml").write_text(CONFIG, encoding="utf-8")
    assert blind_phase_s(Config.load(tmp_path / "nav.toml").override(**changed)) == phase_s


@pytest.mark.parametrize("output", ["shm:blind", "latest.bin", "zmq://5599 --with-truth"])
def test_a_blind_export_passes_no_truth_on(output: str, blind_set: Path) -> None:
    words = ("-c", "nav.toml", "-o", "seen_on", "--blind", "hidden_on", "--latest-frame", *output.split())
    refused = in_folder(blind_set, "export", *words)

    assert refused.rc == 2
    assert "pass on the truth" in " ".join(refused.err.replace("│", " ").split())
    assert not (blind_set / "hidden_on").exists()


def test_default_seeds_of_a_blind_set_are_named(blind_set: Path) -> None:
    words = ("export", "-c", "nav.toml", "-o", "seen", "--blind", "hidden")
    assert "give --seed a number of your own" in in_folder(blind_set, *words).err


def test_the_residuals_of_the_attitude_are_those_of_the_error_model(blind_set: Path) -> None:
    nav, truth = lines_of(blind_set / "seen" / "nav.jsonl"), lines_of(blind_set / "hidden" / "truth.jsonl")
    estimates = np.array([record["q_body_ned"]["middle"] for record in nav])
    residual_deg = np.rad2deg(turn_between(np.array([frame["q_body_ned"] for frame in truth]), estimates))

    # A bias of 0.25 deg in roll, a drift of 0.15 deg, noise of 0.05 deg at most, and 10 ms at 5 deg/s.
    assert np.abs(residual_deg - [0.25, 0.0, 0.0]).max() < 4 * 0.15 + 0.05 + 0.06
    assert np.ptp(residual_deg, axis=0).min() > 0.02
    # The best constant correction of the residuals, the most that a bias can be mended to, leaves drift and noise.
    assert (residual_deg - residual_deg.mean(axis=0)).std() > 0.02


def test_the_mount_is_nominal_and_the_camera_is_turned_by_its_error(blind_set: Path) -> None:
    nav, truth = lines_of(blind_set / "seen" / "nav.jsonl"), lines_of(blind_set / "hidden" / "truth.jsonl")
    nominal, real = np.array(nav[0]["C_camera_body"]), np.array(truth[0]["C_camera_body"])

    angle_deg = np.rad2deg(np.arccos((np.trace(nominal.T @ real) - 1) / 2))
    assert angle_deg == pytest.approx(0.4, rel=0, abs=1e-6)
    np.testing.assert_allclose(nominal[2], [0, 0, -1], rtol=0, atol=1e-12)


def test_clock_up_and_rates_belong_to_the_estimated_attitude(blind_set: Path) -> None:
    nav, truth = lines_of(blind_set / "seen" / "nav.jsonl"), lines_of(blind_set / "hidden" / "truth.jsonl")

    for record, frame in zip(nav, truth, strict=True):
        assert parse_utc(record["utc"]["middle"]) - parse_utc(frame["utc_mid"]) == pytest.approx(0.01, rel=0, abs=2e-6)
        for instant, q_body_ned in record["q_body_ned"].items():
            up = np.array(record["C_camera_body"]) @ matrix_from_quaternion(np.array(q_body_ned)) @ [0, 0, -1]
            np.testing.assert_allclose(record["up_camera"][instant], up, rtol=0, atol=1e-12)
        # 18 m/s on 200 m are 5.16 deg/s; the gusts of light turbulence add some.
        assert np.linalg.norm(record["rates_rad_per_s"]) == pytest.approx(18 / 200, rel=0, abs=0.12)


def test_the_same_command_continues_and_a_navigator_never_gets_the_directory_of_the_truth(blind_set: Path) -> None:
    before = (blind_set / "seen" / "nav.jsonl").read_bytes()

    again = in_folder(blind_set, "export", "-c", "nav.toml", "-o", "seen", "--blind", "hidden")
    assert again.out.startswith("0 frames drawn")
    assert (blind_set / "seen" / "nav.jsonl").read_bytes() == before

    swapped = in_folder(blind_set, "export", "-c", "nav.toml", "-o", "hidden", "--blind", "other")
    assert (swapped.rc, swapped.err.count("\n")) == (1, 1)
    assert "holds manifest.json of another export" in swapped.err
    inside = in_folder(blind_set, "export", "-c", "nav.toml", "-o", "new", "--blind", "new/truth")
    assert inside.rc == 2
    assert not (blind_set / "new").exists()


def test_only_files_of_a_navigator_may_be_in_its_directory(tmp_path: Path) -> None:
    for name in ("frame_000001.png", "frame_000002.fits", "nav.jsonl", "train.txt", "notes.md"):
        (tmp_path / name).touch()
    refuse_other_files(tmp_path)
    with pytest.raises(ExportError, match=r"holds frame_000002\.fits of another export"):
        refuse_other_files(tmp_path, {"frame_000001.png"})
    for name in ("truth.jsonl", "frame_000001.trails.png", "frame_000001.light.tiff", "splits.json", "DATACARD.md"):
        (tmp_path / name).touch()
        with pytest.raises(ExportError, match=re.escape(f"holds {name} of another export")):
            refuse_other_files(tmp_path)
        (tmp_path / name).unlink()


def test_the_attitude_of_another_message_of_the_log_is_the_estimate(tmp_path: Path) -> None:
    exported = in_folder(tmp_path, "export", "-o", "set", "--navigator", "ATT", "--frames", "2")
    assert exported.rc == 0, exported.err

    nav, truth = lines_of(tmp_path / "set" / "nav.jsonl"), lines_of(tmp_path / "set" / "truth.jsonl")
    for record, frame in zip(nav, truth, strict=True):
        off_deg = np.rad2deg(
            np.linalg.norm(turn_between(np.array(frame["q_body_ned"]), np.array(record["q_body_ned"]["middle"])))
        )
        # ATT is XKQ at 10 Hz, rounded to 0.01 deg.
        assert 1e-4 < off_deg < 2.0


def test_a_gap_of_the_message_is_no_estimate() -> None:
    config = Config().override(**{"navigator.attitude": "ATT"})
    flight = config.open_flight(asset("adelaide.BIN"))
    attitude = config.override(**{"flight.attitude": "ATT"}).open_flight(asset("adelaide.BIN")).attitude
    first_s = attitude.first_s
    kept = (attitude.utc_s < first_s + 20.0) | (attitude.utc_s > first_s + 25.0)
    message = AttitudeTrack.from_samples(attitude.utc_s[kept], attitude.q_body_ned[kept])
    navigator = Navigator.of(config, flight, estimate=message)

    def known(start_s: float) -> dict[str, Any]:
        return navigator.record(Exposure(first_s + start_s, 0.5), number=0, file="frame_000000.png")

    for start_s in (19.0, 25.5):
        assert known(start_s)["q_body_ned"].keys() == {"start", "middle", "end"}
    for start_s in (19.8, 22.0, 24.8):
        record = known(start_s)
        assert (record["q_body_ned"], record["rates_rad_per_s"], record["up_camera"]) == (None, None, None)
        assert record["utc"].keys() == {"start", "middle", "end"}


def test_the_estimate_of_a_link_drifts_for_hours_without_a_known_end() -> None:
    keys = {"drift_sigma_deg": 0.1, "drift_time_s": 60.0, "seed": 5}
    config = Config().override(**{f"navigator.{key}": value for key, value in keys.items()})
    begins_s = parse_utc("2024-03-10T11:00:00Z")
    utc_s = begins_s + np.arange(0.0, 3.5 * 3600, 60.0)
    still = AttitudeTrack.from_samples(utc_s, np.tile([1.0, 0.0, 0.0, 0.0], (utc_s.size, 1)), max_gap_s=120.0)
    flight = Flight(still, PositionTrack.fixed(Site(-0.61, 2.42)))
    navigator = LiveNavigator(config, None)

    def error_deg(number: int) -> float:
        exposure = Exposure(begins_s + 600.0 * number, 0.5)
        record = navigator.record(
            Estimate(still, None, "ATTITUDE"), exposure, number=number, file="a.png", flight=flight
        )
        return float(np.rad2deg(np.linalg.norm(turn_between(np.eye(4)[0], np.array(record["q_body_ned"]["middle"])))))

    # Three components of 0.1 deg each, of which those of ten minutes later know nothing.
    errors_deg = np.array([error_deg(number) for number in range(20)])
    assert np.sqrt((errors_deg**2).mean()) == pytest.approx(0.173, rel=0, abs=0.06)
    assert np.abs(np.diff(errors_deg)).min() > 1e-4


def test_without_a_navigator_there_is_no_record(tmp_path: Path) -> None:
    assert in_folder(tmp_path, "export", "-o", "set", "--frames", "1").rc == 0

    assert not (tmp_path / "set" / "nav.jsonl").exists()


def test_the_gimbal_turns_the_estimate_of_the_aircraft_onto_its_platform(tmp_path: Path) -> None:
    settings = tmp_path / "gimbal.toml"
    settings.write_text(
        '[mount]\ngimbal = "level"\n[navigator]\nroll_bias_deg = 0.5\n[flight.synthetic]\npath = "orbit"\n'
        "[camera]\nwidth_px = 64\nheight_px = 48\nfx_px = 61\nfy_px = 61\n"
    )
    run = in_folder(tmp_path, "export", "-c", settings.name, "-o", "set", "--frames", "2")
    assert run.rc == 0, run.err
    for truth, nav in zip(
        lines_of(tmp_path / "set" / "truth.jsonl"), lines_of(tmp_path / "set" / "nav.jsonl"), strict=True
    ):
        aircraft, joints, platform = (
            Rotation.from_quat(np.roll(q["middle"], -1))
            for q in (nav["gimbal"]["q_aircraft_ned"], nav["gimbal"]["q_gimbal_aircraft"], nav["q_body_ned"])
        )
        assert ((platform * aircraft.inv()) * joints.inv()).magnitude() < 1e-9
        real = {key: Rotation.from_quat(np.roll(q, -1)) for key, q in truth["gimbal"].items()}["q_aircraft_ned"]
        # The platform is level in truth; the roll bias of the aircraft tilts what the navigator believes of it.
        level = Rotation.from_quat(np.roll(truth["q_body_ned"], -1)).inv().as_euler("ZYX", degrees=True)
        assert np.abs(level[1:]).max() < 1e-9
        assert np.rad2deg((aircraft * real.inv()).magnitude()) == pytest.approx(0.5, abs=1e-6)
        assert np.rad2deg((platform * Rotation.from_quat(np.roll(truth["q_body_ned"], -1)).inv()).magnitude()) == (
            pytest.approx(0.5, abs=1e-6)
        )


def test_each_sample_of_a_set_has_the_navigator_of_its_settings(tmp_path: Path) -> None:
    section = CONFIG[: CONFIG.index("[flight.synthetic]")] + '[flight.synthetic]\npath = "still"\n'
    sweep = "[navigator]\nroll_bias_deg = 2.0\n[sweep]\nnavigator.roll_bias_deg = [1.0, 11.0, 4.0]\n"
    (tmp_path / "set.toml").write_text(section + sweep)

    made = CliRunner().invoke(app, ["export", "-c", str(tmp_path / "set.toml"), "-o", str(tmp_path), "--frames", "2"])

    assert made.exit_code == 0, made.output
    lines = lines_of(tmp_path / "nav.jsonl")
    first = np.array(lines[0]["q_body_ned"]["middle"])
    turns_deg = [np.rad2deg(turn_between(first, np.array(line["q_body_ned"]["middle"]))) for line in lines]
    np.testing.assert_allclose(np.abs(turns_deg)[:, 0], [0, 0, 10, 10, 3, 3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.array(turns_deg)[:, 1:], 0, rtol=0, atol=1e-6)
