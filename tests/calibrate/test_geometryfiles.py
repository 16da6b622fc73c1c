"""The camera of one photograph or of several as TOML, JSON and CSV, and the notes on it."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar import __version__
from glstar.calibrate.geometry.camera import (
    GeometryCalibration,
    calibrate_geometry,
    calibration_toml,
    camera_notes,
    refraction_notes,
    share_geometry,
)
from glstar.calibrate.geometry.lenschoice import LensTrial
from glstar.calibrate.geometry.lensfit import SharedLensFit, SingleImageFit, centroid_noise_px
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.identify.rollingshutter import ReadoutTime
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.12346, 690.5, 322.0, 236.0, 0.5, Lens("plumb_bob", (-0.1, 0.02)))
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
ICRS = about_z(0.01)
FIRST, SECOND = Note(NoteKind.CAMERA, "first"), Note(NoteKind.CAMERA, "second")
HEAD = [f"# Camera by glstar {__version__} from "]


class Detections(SimpleNamespace):
    """The part of `DetectedStars` that is used here."""

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def signal_to_noise(self) -> np.ndarray:
        return self.peak_dn / self.noise_dn


def detections(**more: object) -> Detections:
    usual = {
        "xy_px": np.array([[1.0, 2.0], [30.12346, 40.5], [50.0, 60.25], [7.0, 8.0]]),
        "peak_dn": np.array([9.0, 40.0, 60.0, 5.0]),
        "noise_dn": np.array([2.0, 4.0, 2.0, 1.0]),
        "saturated": np.array([False, False, True, False]),
        "psf_sigma_px": 1.2,
        "drawn_out_px": 0.0,
    }
    return Detections(**usual | {"hot_pixels": 6, "at_the_edge": 7, "shapeless": 8} | more)


def reference(**more: object) -> ReferenceStars:
    stars = SimpleNamespace(
        C_eq_icrs=ICRS, catalogue="bsc5", star_id=np.array([11, 22, 33]), name=np.array(["", "Vega", "Mu, Nu"]),
        vmag=np.array([3.0, 0.034, 4.567]),
    )  # fmt: skip
    return ReferenceStars(stars, **{**nowhere(), **more})


def nowhere() -> dict[str, object]:
    return {"zenith_eq": np.zeros(3), "velocity_eq": np.zeros(3), "refraction_scale": 0.0, "C_ned_eq": None}


def matches(**more: object) -> Matches:
    usual = {
        "solution": PlateSolution(CAMERA, TURN, k1=0.25), "star": np.array([1, 2]), "detection": np.array([2, 1]),
        "residual_px": np.array([[0.3, -0.4], [0.6, 0.8]]), "predicted": np.arange(5), "chance": 1e-20,
        "predicted_xy_px": np.zeros((5, 2)), "expected_by_chance": 0.02,
        "standard_error": {"fx_px": 0.123, "k1": 0.004},
    }  # fmt: skip
    return Matches(**usual | more)


def part(name: str = "a.png", notes: tuple[Note, ...] = (FIRST,), **more: object) -> GeometryCalibration:
    image = Photograph(Path("folder") / name, np.zeros((480, 640)), 12, "green", 0.5)
    usual = {"detected": detections(), "reference": reference(), "matches": matches(), "method": "by labels"}
    return GeometryCalibration(image, **usual | more, notes=notes)


def test_all_numbers_of_a_photograph_are_in_its_json() -> None:
    axis = TURN[2] @ ICRS
    ra, dec = np.rad2deg(np.arctan2(axis[1], axis[0])) % 360, np.rad2deg(np.arcsin(axis[2]))
    assert np.rad2deg(part().boresight_rad).tolist() == pytest.approx([ra, dec])
    numbers = part().to_json()
    identification = {
        "method": "by labels", "stars_on_image": 5, "identified": 2, "expected_by_chance": 0.02,
        "rms_px": pytest.approx(np.sqrt((0.25 + 1) / 2)), "median_px": pytest.approx(0.75),
        "centroid_noise_px": centroid_noise_px(detections(), np.array([2, 1])), "chance": 1e-20, "mirrored": False,
        "fx_px": 700.12346, "fy_px": 690.5,
        "field_of_view_deg": pytest.approx(np.rad2deg(CAMERA.horizontal_field_rad)), "cx_px": 322.0, "cy_px": 236.0,
        "radial_distortion_k1": 0.25, "standard_error": {"fx_px": 0.123, "k1": 0.004}, **CAMERA.lens.keys,
        "C_camera_icrs": (TURN @ ICRS).tolist(), "ra_deg": pytest.approx(ra), "dec_deg": pytest.approx(dec),
    }  # fmt: skip
    assert numbers == {
        "schema": 2, "glstar": __version__, "sensor": None, "notes": ["first"],
        "image": {"file": "a.png", "width_px": 640, "height_px": 480, "bit_depth": 12, "channel": "green"},
        "detection": {"stars": 4, "saturated": 1, "hot_pixels": 6, "at_the_edge": 7, "shapeless": 8},
        "identification": identification,
    }  # fmt: skip
    json.dumps(numbers)
    pinhole = PlateSolution(replace(CAMERA, lens=None), TURN)
    time = ReadoutTime(0.016, 0.0003, "up", False, 37, 2, 0.1)
    found = part(matches=matches(solution=pinhole, readout=time)).to_json()["identification"]
    assert set(found) == set(identification) - set(CAMERA.lens.keys) | set(time.to_json())


def test_the_altitude_is_known_with_the_site_or_by_refraction() -> None:
    over = part(reference=reference(C_ned_eq=TURN)).to_json()["identification"]
    # The axis is down in the frame of the site.
    assert (over["altitude_deg"], type(over["azimuth_deg"])) == (pytest.approx(-90.0), float)
    zenith = TURN.T @ [0.0, np.cos(0.5), np.sin(0.5)]
    by_refraction = part(reference=reference(zenith_eq=zenith, zenith_error_rad=0.02)).to_json()["identification"]
    assert by_refraction["altitude_deg"] == pytest.approx(np.rad2deg(0.5))
    assert by_refraction["zenith_error_deg"] == pytest.approx(np.rad2deg(0.02))
    assert "azimuth_deg" not in by_refraction
    east = part(reference=reference(C_ned_eq=np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]]) @ TURN))
    found = east.to_json()["identification"]
    assert (found["azimuth_deg"], found["altitude_deg"]) == (pytest.approx(90.0), pytest.approx(0.0, abs=1e-9))


def test_identified_stars_are_lines_of_a_table() -> None:
    assert part().to_csv() == (
        "catalogue,star_id,name,vmag,x_px,y_px,residual_x_px,residual_y_px,signal_to_noise,saturated\n"
        "bsc5,22,Vega,0.03,50.0000,60.2500,0.3000,-0.4000,30.0000,1\n"
        'bsc5,33,"Mu, Nu",4.57,30.1235,40.5000,0.6000,0.8000,10.0000,0\n'
    )


def test_a_camera_is_written_with_its_errors() -> None:
    assert part().to_toml() == (
        f"# Camera by glstar {__version__} from a.png: 2 stars identified (by labels).  Geometry only: no sensor.\n"
        "# first.\n\n# The camera fitted to the stars.\n# Standard errors: fx_px 0.12, k1 0.004.\n[camera]\n"
        "width_px = 640\nheight_px = 480\nfx_px = 700.1235\nfy_px = 690.5\ncx_px = 322.0\ncy_px = 236.0\n"
        "skew_px = 0.5\n"
        'lens = "plumb_bob"\ndistortion = [-0.1, 0.02]\n'
    )
    pinhole = PlateSolution(replace(CAMERA, lens=None), TURN, True, -0.12345)
    time = ReadoutTime(0.016, 0.0003, "up", False, 37, 2, 0.1)
    written = calibration_toml([], None, matches(solution=pinhole, standard_error={}, readout=time))
    assert written.startswith(
        "\n# The pinhole fitted to the stars, with a radial distortion (OpenCV's k1) of -0.1235.\n"
        "# Left and right are exchanged on the image.\n[camera]\n"
    )
    assert written.endswith('skew_px = 0.5\n\n# The rolling shutter\'s readout time: standard error 0.0003 s.\n'
                            '[exposure]\nreadout_s = 0.016\nreadout = "up"\n')  # fmt: skip


def test_a_sensor_is_written_before_its_camera_and_effects_of_others_after_it() -> None:
    effects = {"sensor.psf_beta": 3.5, "lens.vignetting": [0.1, 0.2], "lens.flare": 0.5, "air.extinction": 0.25}
    sensor = SimpleNamespace(keys={"gain": 2.0, "effects": effects}, effects=effects)
    written = calibration_toml(["head"], sensor, matches(), sensor_error={"gain": 0.0123}, star_brightness="b.csv")
    assert written.startswith(
        '# head\n\n# Standard errors: gain 0.012.\n[sensor]\ngain = 2.0\npsf_beta = 3.5\nstar_brightness = "b.csv"\n\n'
        "# The camera fitted to the stars.\n"
    )
    tables = tomllib.loads(written)
    assert tables["lens"] == {"vignetting": [0.1, 0.2], "flare": 0.5}
    assert tables["air"] == {"extinction": 0.25}
    assert tables["camera"]["distortion"] == [-0.1, 0.02]
    assert written.endswith("\n\n[lens]\nvignetting = [0.1, 0.2]\nflare = 0.5\n\n[air]\nextinction = 0.25\n")
    plain = calibration_toml([], sensor, matches())
    assert plain.startswith("\n[sensor]\ngain = 2.0\npsf_beta = 3.5\n\n# The camera")


def test_residuals_beyond_half_the_width_of_a_star_are_noted() -> None:
    rms = matches().rms_px
    assert camera_notes(matches(), rms / 0.5 * 1.001) == ()
    [note] = camera_notes(matches(), rms / 0.5 * 0.999)
    assert str(note).startswith("the fitted camera is off by 0.79 px rms from the stars, although a sigma of 1.58 px")
    assert "it is not exactly such a plumb_bob lens, or" in str(note)
    pinhole = matches(solution=PlateSolution(replace(CAMERA, lens=None, cx_px=700.0), TURN))
    outside, note = camera_notes(pinhole, 1.0)
    assert str(outside).startswith("the principal point (700.0, 236.0) lies outside the image")
    assert "it is not exactly a pinhole, or" in str(note)
    assert {one.kind for one in (outside, note)} == {NoteKind.CAMERA}


def test_unknown_refraction_is_noted_if_the_focal_length_shows_it() -> None:
    unknown = 1.55 * 2.8e-4 * 700.12346
    for error_px, noted in ((2 * unknown * 0.999, True), (2 * unknown * 1.001, False), (None, False)):
        found = matches(standard_error={} if error_px is None else {"fx_px": error_px})
        notes = refraction_notes(reference(), found)
        assert bool(notes) == noted
    [note] = refraction_notes(reference(), matches(standard_error={"fx_px": 0.1}))
    assert "the focal length is 0.03% too short if the camera pointed at the zenith" in str(note)
    assert refraction_notes(reference(C_ned_eq=np.eye(3)), matches(standard_error={"fx_px": 0.1})) == ()
    zenith = TURN.T @ [np.sin(0.5), 0.0, np.cos(0.5)]
    shown = reference(zenith_eq=zenith, zenith_error_rad=0.05, refraction_scale=1.0)
    [note] = refraction_notes(shown, matches())
    declination = np.rad2deg(np.arcsin(zenith[2]))
    assert f"shows the zenith 29 ± 3 deg from the optical axis, at declination {declination:.0f} deg (" in str(note)


def test_elongated_stars_are_noted() -> None:
    image = Photograph(Path("a.png"), np.zeros((480, 640)), 12, "green", 0.5)
    found = matches(notes=(SECOND,), residual_px=np.zeros((2, 2)), standard_error={})
    plain = calibrate_geometry(image, detections(), reference(), found, method="by labels", notes=(FIRST,))
    assert (plain.notes, plain.method, plain.matches) == ((FIRST, SECOND), "by labels", found)
    assert calibrate_geometry(image, detections(), reference(), found, method="by labels").notes == (SECOND,)
    moved = calibrate_geometry(image, detections(drawn_out_px=3.21), reference(), found, method="by labels")
    assert [str(note) for note in moved.notes] == [
        "second",
        "the stars are elongated by about 3.2 px: the attitude is that of mid-exposure if the camera moved steadily",
    ]


def test_several_photographs_share_a_camera_and_their_common_notes() -> None:
    both = (part("a.png", (FIRST, SECOND)), part("b.png", (SECOND,), matches=matches(star=np.array([1, 2, 0]))))
    single = SingleImageFit(replace(CAMERA, fx_px=699.0), {"fx_px": 0.4, "k1": 0.02})
    lens = SharedLensFit(
        tuple(one.matches for one in both), LensTrial("plumb_bob of 2", 9, 0.25, -5.0), {"fx_px": 0.3, "k1": 0.01},
        (single, None),
    )  # fmt: skip
    shared = share_geometry(both, lens)
    summary = f"one lens fitted to 5 stars of 2 images: {CAMERA.lens}, f = 700.12 ± 0.30 px (from one image ± 0.40 to"
    assert lens.summary == f"{summary} 0.40), 0.250 px rms"
    assert [str(note) for note in shared.notes] == [lens.summary, "a.png: first", "second"]
    assert shared.best is both[1]
    assert shared.to_toml().startswith(
        f"# Camera by glstar {__version__} from 2 images (a.png, b.png): 5 stars identified.  Geometry only: no"
        f" sensor.\n# {lens.summary}.\n# a.png: first.\n# second.\n\n# The camera"
    )
    assert shared.to_json() == {
        "schema": 2, "glstar": __version__, "sensor": None, "notes": [str(note) for note in shared.notes],
        "shared_lens": {
            "lens": "plumb_bob of 2", "stars": 5, "rms_px": 0.25, "parameters": {"fx_px": 700.12346, "k1": -0.1},
            "standard_error": {"fx_px": 0.3, "k1": 0.01},
            "single_images": [
                {"file": "a.png", "parameters": {"fx_px": 699.0, "k1": -0.1}, "standard_error": single.standard_error},
                {"file": "b.png"},
            ],
        },
        "images": [one.to_json() for one in both],
    }  # fmt: skip
    none = replace(
        lens, single=(None, None), matches=(matches(solution=PlateSolution(replace(CAMERA, lens=None), TURN)),)
    )
    assert none.summary == "one lens fitted to 2 stars of 1 images: a pinhole, f = 700.12 ± 0.30 px, 0.250 px rms"
