"""What is known of photographs before their stars are identified."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate import inputs
from glstar.calibrate.identify.hints import Label
from glstar.calibrate.identify.platesolution import nominal_camera
from glstar.calibrate.inputs import (
    ImageReference,
    PhotographInputs,
    _binned,
    _exposures,
    _Moment,
    _oriented,
    _references,
    _times,
    _with_rows,
    inputs_of,
    read_labels,
)
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.photofile import Exif
from glstar.config import Config
from glstar.errors import CalibrationError, ConfigError
from glstar.flight import AttitudeTrack
from glstar.rotation import matrix_from_euler, matrix_from_quaternion, quaternion_from_turn
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc

UTC = "2024-03-10T11:00:05Z"
UTC_S = parse_utc(UTC)
CAMERA = Camera(800, 600, 900.0, 880.0, 410.0, 290.0, 1.5, Lens("plumb_bob", (-0.1, 0.02, 0.003, 0.004)))


def photo(width: int, height: int, exposure_s: float | None = None) -> Photograph:
    return Photograph(Path("p.png"), np.zeros((height, width)), 8, "grey", exposure_s)


def known(**more: object) -> PhotographInputs:
    reference = SimpleNamespace(C_body_ned=None, stars=SimpleNamespace(C_ned_eq=None))
    usual = {"config": SimpleNamespace(camera=lambda: CAMERA), "has_camera": False, "reference": reference}
    return PhotographInputs(**usual | {"given_exposure_s": None, "fov_deg": None, "labels": None} | more)


def test_the_exposure_is_the_given_one_or_that_of_the_file() -> None:
    assert known(given_exposure_s=0.7).exposure_s(photo(40, 40, 0.3)) == 0.7
    assert known().exposure_s(photo(40, 40, 0.3)) == 0.3
    with pytest.raises(CalibrationError, match=r"p\.png: does not state its exposure.*give --exposure S"):
        known().exposure_s(photo(40, 40))
    for value in (0.0, -0.2, np.nan):
        with pytest.raises(ConfigError, match=f"--exposure must be a positive number of seconds, not {value}"):
            known(given_exposure_s=value).exposure_s(photo(40, 40, 0.3))
    assert [one.focal_is_known for one in (known(), known(has_camera=True), known(has_camera=True, fov_deg=30.0))] == [
        *(False, True, False)
    ]


def test_the_camera_is_that_of_the_field_of_view_or_of_the_config() -> None:
    assert known(fov_deg=50.0).camera(photo(400, 300)) == nominal_camera(400, 300, np.deg2rad(50.0))
    assert known(has_camera=True, fov_deg=50.0).camera(photo(400, 300)) == nominal_camera(400, 300, np.deg2rad(50.0))
    assert known(labels=[]).camera(photo(400, 300)) == nominal_camera(400, 300, np.deg2rad(60.0))
    with pytest.raises(CalibrationError, match=r"has no known field of view; give --fov DEG"):
        known().camera(photo(400, 300))
    assert known(has_camera=True).camera(photo(800, 600)) == CAMERA
    turned = known(has_camera=True).camera(photo(600, 800))
    assert turned == _oriented(CAMERA, is_wide=False)
    assert (turned.width_px, turned.height_px, turned.fx_px, turned.fy_px) == (600, 800, 880.0, 900.0)


def test_a_turned_camera_sees_the_same_turned_image() -> None:
    straight = replace(CAMERA, skew_px=0.0)
    assert _oriented(straight, is_wide=True) is straight
    turned = _oriented(straight, is_wide=False)
    assert (turned.width_px, turned.height_px) == (600, 800)
    ray = np.array([[0.2, -0.13, 1.0], [-0.3, 0.05, 1.0]])
    # A quarter turn: the camera's x becomes y, and its y minus x.
    x, y = straight.project(ray).T
    found = turned.project(np.column_stack([-ray[:, 1], ray[:, 0], ray[:, 2]]))
    np.testing.assert_allclose(found, np.column_stack([599 - y, x]), rtol=0, atol=1e-9)
    assert _oriented(replace(straight, lens=None), is_wide=False).lens is None
    portrait = Camera(600, 800, 700.0, 710.0, 300.0, 390.0)
    assert _oriented(portrait, is_wide=False) is portrait
    assert _oriented(portrait, is_wide=True).width_px == 800
    square = Camera(600, 600, 700.0, 710.0, 300.0, 390.0)
    assert _oriented(square, is_wide=False) is square


def test_a_binned_camera_has_the_scale_of_the_image() -> None:
    binned = _binned(CAMERA, photo(400, 200 + 100))
    assert (binned.width_px, binned.height_px, binned.fx_px, binned.fy_px, binned.skew_px) == (400, 300, 450, 440, 0.75)
    assert (binned.cx_px, binned.cy_px, binned.lens) == (204.75, 144.75, CAMERA.lens)
    uneven = _binned(CAMERA, photo(202, 151))
    assert (uneven.fx_px, uneven.fy_px) == pytest.approx((900 * 202 / 800, 880 * 151 / 600))
    assert (uneven.cx_px, uneven.cy_px) == pytest.approx((410.5 * 202 / 800 - 0.5, 290.5 * 151 / 600 - 0.5))
    assert uneven.skew_px == pytest.approx(1.5 * 202 / 800)
    # The ratio of the sides may differ by a hundredth.
    assert _binned(CAMERA, photo(1003, 745)).height_px == 745  # 0.97 %
    for size in ((1004, 745), (1000, 758)):  # 1.07 % wider, and 1.06 % narrower
        with pytest.raises(
            CalibrationError, match=f"is {size[0]} x {size[1]} px and the config's camera 800 x 600: no"
        ):
            _binned(CAMERA, photo(*size))


def test_an_attitude_over_a_site_is_turned_by_the_mount() -> None:
    mount, body, ned = (
        matrix_from_quaternion(quaternion_from_turn(t)) for t in ([0.1, 0.2, 0.3], [0, 1, 0], [2, 0, 1])
    )
    config = SimpleNamespace(mount=lambda: SimpleNamespace(C_camera_body=mount))

    def of(C_body_ned: np.ndarray | None, C_ned_eq: np.ndarray | None) -> PhotographInputs:
        stars = SimpleNamespace(C_ned_eq=C_ned_eq)
        return known(config=config, reference=SimpleNamespace(C_body_ned=C_body_ned, stars=stars))

    solution = of(body, ned).solution(CAMERA)
    np.testing.assert_allclose(solution.C_camera_eq, mount @ body @ ned, rtol=0, atol=1e-12)
    assert (solution.camera, solution.mirrored) == (CAMERA, False)
    assert of(None, ned).solution(CAMERA) is None
    assert of(body, None).solution(CAMERA) is None


def test_exposures_and_times_are_given_once_or_once_each() -> None:
    assert _exposures(None, 2) == _exposures([], 2) == [None, None]
    assert _exposures(3, 2) == _exposures([3.0], 2) == [3.0, 3.0]
    assert _exposures((0.5, 0.7), 2) == [0.5, 0.7]
    with pytest.raises(ConfigError, match="--exposure is given 2 times for 3 images: give it once, or once each"):
        _exposures([1.0, 2.0], 3)
    later = "2024-03-10T12:00:05Z"
    assert _times(None, 2) == _times([], 2) == [None, None]
    assert _times(UTC, 1) == [UTC_S]
    assert _times([UTC, later], 2) == [UTC_S, UTC_S + 3600]
    with pytest.raises(ConfigError, match="--utc is given 1 times for 2 images: give it once each, or leave it out"):
        _times(UTC, 2)


def test_the_time_of_exif_is_the_middle_of_the_exposure() -> None:
    exif = Exif(utc_s=UTC_S, zone="zone +01:00", exposure_s=0.5, site_deg=(10.12345, -20.0))
    text = "time by EXIF, zone +01:00: 2024-03-10T11:00:0{}Z; place by EXIF: 10.1235, -20.0000 deg"
    for exposure_s, own_s, middle_s, shown in ((3.0, 0.5, 1.5, "6.500000"), (None, 0.5, 0.25, "5.250000")):
        found = _Moment.of(None, replace(exif, exposure_s=own_s), exposure_s)
        assert (found.utc_s, found.site_deg, found.is_exif) == (UTC_S + middle_s, (10.12345, -20.0), True)
        assert found.notes == (Note(NoteKind.CAMERA, text.format(shown)),)
    unknown = _Moment.of(None, replace(exif, exposure_s=None, site_deg=None), None)
    assert unknown == _Moment(
        UTC_S,
        None,
        is_exif=True,
        notes=(Note(NoteKind.CAMERA, "time by EXIF, zone +01:00: 2024-03-10T11:00:05.000000Z"),),
    )
    assert _Moment.of(7.0, exif, 3.0) == _Moment(7.0)
    assert _Moment.of(None, Exif(zone="zone +01:00"), 3.0) == _Moment(None)
    text = "its EXIF has a time without a zone, which is not used; give --utc, and --lat and --lon"
    assert _Moment.of(None, replace(exif, zone=None), 3.0) == _Moment(None, notes=(Note(NoteKind.CAMERA, text),))


TRACK = AttitudeTrack.from_samples(
    UTC_S + np.arange(-64, 65) / 64, quaternion_from_turn(np.array([0.3, 0.1, -0.2]) * np.arange(-64, 65)[:, None] / 64)
)
NOTE = Note(NoteKind.CAMERA, "a note")


@pytest.fixture
def over(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Record for which times and sites the stars are asked for."""
    asked: list[tuple[object, ...]] = []

    def recorded(kind: str):
        def stars(sky, utc_s, site=None):
            asked.append((kind, utc_s, site))
            return SimpleNamespace(kind=kind)

        return stars

    fake = SimpleNamespace(over=recorded("over"), anywhere=recorded("anywhere"))
    monkeypatch.setattr(inputs, "ReferenceStars", fake)
    monkeypatch.setattr(inputs, "_with_rows", lambda stars, *rest, **more: (SimpleNamespace(rows=rest), (NOTE,)))
    return asked


def config(**air: float) -> SimpleNamespace:
    settings = Config().override(**{"air.pressure_hpa": 900.0, "air.temperature_c": -4.0})
    flight = SimpleNamespace(
        attitude=TRACK, time_offset_s=0.25, position=SimpleNamespace(at=lambda utc_s: Site(0.1, 0.2, utc_s - UTC_S))
    )
    return SimpleNamespace(
        sky=settings.sky, air=settings.air, exposure=settings.exposure, open_flight=lambda path: flight
    )


AIR = {"pressure_hpa": 900.0, "temperature_c": -4.0}


def test_images_have_the_stars_over_their_own_time_and_place(over) -> None:
    moments = [_Moment(UTC_S, (30.0, 40.0), is_exif=True, notes=(NOTE,)), _Moment(UTC_S + 60)]
    by_exif, unknown = _references(config(), moments, None, None, None, fit_readout=False)
    site = Site(np.deg2rad(30.0), np.deg2rad(40.0))
    assert over == [("over", UTC_S, replace(site, **AIR)), ("anywhere", UTC_S + 60, None)]
    assert (by_exif.is_by_exif, by_exif.notes, by_exif.C_body_ned, by_exif.refraction_scale) == (True, (NOTE,), None, 0)
    assert (unknown.is_by_exif, unknown.notes, unknown.C_body_ned) == (False, (), None)
    # Refraction grows with the density of the air.
    assert unknown.refraction_scale == pytest.approx(900 / 1010 * 283 / 269, rel=1e-6)
    over.clear()
    [given] = _references(config(), moments[:1], (-35.0, 138.0), (70.0, 3.0, -4.0), None, fit_readout=False)
    assert over == [("over", UTC_S, Site(np.deg2rad(-35.0), np.deg2rad(138.0), **AIR))]
    np.testing.assert_allclose(given.C_body_ned, matrix_from_euler(*np.deg2rad([-4.0, 3.0, 70.0])), rtol=0, atol=1e-12)
    assert not given.is_by_exif
    assert given.catalogue.vmag.max() > 7.5


def test_images_without_time_share_their_stars_and_keep_their_notes(over) -> None:
    moments = [_Moment(None), _Moment(UTC_S), _Moment(None), _Moment(None, notes=(NOTE,))]
    # A note on the EXIF of the first image is not one on that of the second.
    of_first, of_second = _references(config(), [moments[3], moments[0]], None, None, None, fit_readout=False)
    assert of_second.stars is of_first.stars
    assert (of_first.notes, of_second.notes) == ((NOTE,), ())
    over.clear()
    first, _, again, noted = _references(config(), moments, None, None, None, fit_readout=False)
    assert over == [("anywhere", parse_utc("2020-01-01T00:00:00Z"), None), ("anywhere", UTC_S, None)]
    assert again is first
    assert noted.stars is first.stars
    assert (first.notes, noted.notes) == ((), (NOTE,))
    for site in (None, (1.0, 2.0)):
        moment = _Moment(UTC_S if site is None else None)
        with pytest.raises(ConfigError, match="an attitude needs --utc, --lat and --lon: the sky turns by 15 deg an"):
            _references(config(), [moment], site, (1.0, 2.0, 3.0), None, fit_readout=False)


def test_a_flight_gives_attitude_and_place_by_the_clock_of_its_camera(over) -> None:
    [found] = _references(config(), [_Moment(UTC_S + 0.5, notes=(NOTE,))], None, None, "a.BIN", fit_readout=True)
    assert over == [("over", UTC_S + 0.25, Site(0.1, 0.2, 0.25, **AIR))]
    expected = matrix_from_quaternion(TRACK.at([UTC_S + 0.25]))[0]
    np.testing.assert_allclose(found.C_body_ned, expected, rtol=0, atol=1e-12)
    assert found.stars.rows[:2] == (TRACK, UTC_S + 0.25)
    assert found.notes == (NOTE, NOTE)
    assert not found.is_by_exif
    over.clear()
    [elsewhere] = _references(config(), [_Moment(UTC_S)], (30.0, 40.0), (1.0, 2.0, 3.0), "a.BIN", fit_readout=False)
    assert over[0][2] == Site(np.deg2rad(30.0), np.deg2rad(40.0), **AIR)
    np.testing.assert_allclose(
        elsewhere.C_body_ned, matrix_from_euler(*np.deg2rad([3.0, 2.0, 1.0])), atol=1e-12, rtol=0
    )
    for moments in ([_Moment(None)], [_Moment(UTC_S), _Moment(None)]):
        with pytest.raises(ConfigError, match="--flight needs --utc, the time of the photograph"):
            _references(config(), moments, None, None, "a.BIN", fit_readout=False)


TURNED = matrix_from_euler(0.3, 0.2, 0.1)


def test_rows_are_turned_if_they_are_read_one_after_the_other() -> None:
    exposure = Config().exposure

    def turned(readout_s: float, *, fit: bool = False, C=TURNED, rate: float = 0.374166):
        track = AttitudeTrack.from_samples(
            UTC_S + np.arange(-64, 65) / 64,
            quaternion_from_turn(rate * np.eye(1, 3, 1) * np.arange(-64, 65)[:, None] / 64),
        )
        section = exposure.model_copy(update={"readout_s": readout_s, "readout": "left"})
        stars = replace(PLAIN, C_ned_eq=C)
        return _with_rows(stars, track, UTC_S, section, fit_readout=fit)

    plain, none = turned(0.0)
    assert (plain.rows, none) == (None, ())
    assert turned(0.02, C=None)[0].rows is None
    stars, [note] = turned(0.025)
    assert (stars.rows.readout_s, stars.rows.readout, stars.rows.utc_s) == (0.025, "left", UTC_S)
    assert note == Note(
        NoteKind.CAMERA,
        "the aircraft turned by 0.54 deg while the rolling shutter read the image (25 ms), as the log says: camera and"
        " attitude are those of the middle row",
    )
    fitted, notes = turned(0.0, fit=True)
    assert (fitted.rows.readout_s, notes) == (0.0, ())
    assert turned(0.025, fit=True)[1] == ()
    # From a hundredth of a degree on.
    assert [len(turned(0.1, rate=np.deg2rad(rate))[1]) for rate in (0.098, 0.102)] == [0, 1]
    for readout_s, fit in ((2.2, False), (0.0, True)):
        section = exposure.model_copy(update={"readout_s": readout_s})
        with pytest.raises(CalibrationError, match=f"within {2200 if not fit else 250:g} ms"):
            _with_rows(PLAIN, TRACK, UTC_S + 0.98 * fit, section, fit_readout=fit)


PLAIN = inputs_of(1, fov_deg=40.0, utc=UTC, site_deg=(-35.0, 138.0))[0].reference.stars


def test_inputs_are_those_of_each_image() -> None:
    exif = [Exif(utc_s=UTC_S, zone="zone +00:00", exposure_s=0.5, site_deg=(10.0, 20.0)), Exif()]
    one, other = inputs_of(2, fov_deg=40.0, exposure_s=[1.0, 2.0], exif=exif)
    assert (one.given_exposure_s, other.given_exposure_s, one.fov_deg, one.labels) == (1.0, 2.0, 40.0, None)
    assert (one.has_camera, one.reference.is_by_exif, other.reference.is_by_exif) == (False, True, False)
    assert "11:00:05.500000Z" in str(one.reference.notes[0])
    assert inputs_of(1, config=Config())[0].has_camera
    # A given place is that of all photographs, whatever EXIF says; with --utc, EXIF is not read.
    [placed] = inputs_of(1, fov_deg=40.0, site_deg=(-35.0, 138.0), exif=exif[:1])
    assert (placed.reference.is_by_exif, "place" in str(placed.reference.notes[0])) == (True, False)
    [timed] = inputs_of(1, fov_deg=40.0, utc=UTC, exif=exif[:1])
    assert (timed.reference.notes, timed.reference.stars.C_ned_eq) == ((), None)
    nowhere = one.reference.without_place()
    assert isinstance(nowhere, ImageReference)
    assert (nowhere.stars.C_ned_eq, nowhere.stars.refraction_scale, nowhere.is_by_exif) == (None, 0.0, False)
    assert not np.concatenate([nowhere.stars.zenith_eq, nowhere.stars.velocity_eq]).any()
    assert nowhere.refraction_scale == one.reference.stars.refraction_scale > 0
    assert (nowhere.C_body_ned, nowhere.catalogue) == (None, one.reference.catalogue)
    assert [note.kind for note in nowhere.notes] == [NoteKind.CAMERA]


def test_labels_are_read_in_any_order_and_without_a_header(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    expected = [Label(12.5, 7.25, 2491), Label(30.0, 40.0, 1713)]
    for text in (
        "12.5,7.25,2491\n\n 30 , 40 , 1713 \n",
        "x,y,star_id\n12.5,7.25,2491\n30,40,1713\n",
        "HR,name,Y_px,x_px\n2491,Sirius,7.25,12.5\n , ,,\n1713,Rigel,40,30\n",
    ):
        path.write_text(text)
        assert read_labels(path) == expected
    path.write_text("")
    assert read_labels(path) == []
    for text, line in (("1,2,3\n4,5\n", 2), ("x,y,star_id\n1,2,3\n4,b,6\n", 3), ("x,y\n1,2\n", 1), ("1,2,3.5\n", 1)):
        path.write_text(text)
        message = f"line {line} is no label; each line holds x, y and a star's number"
        with pytest.raises(CalibrationError, match=re.escape(message)):
            read_labels(path)
    path.write_text("x,y,star_id,y\n1,2,3,4\n")
    with pytest.raises(CalibrationError, match="y"):
        read_labels(path)
    path.write_text("1,2,3\n" * (2**20 // 6 + 1))
    with pytest.raises(CalibrationError):
        read_labels(path)
