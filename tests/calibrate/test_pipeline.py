"""The calibration as a function: contradictions are refused before an image is read, and EXIF dates it."""

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import piexif
import pytest
from PIL import Image

import glstar as gs
from glstar.calibrate.geometry.camera import GeometryCalibration
from glstar.calibrate.inputs import inputs_of
from glstar.calibrate.notes import MODEL_NOTES, SHAPE_NOTES, Note, NoteKind, notes_without
from glstar.camera.photofile import Exif
from glstar.camera.sensor.sensor import Sensor
from glstar.sky.place.timescale import parse_utc
from tests.support.starphotos import StarPhoto

PLACE = (-34.93, 138.6)
UTC = "2024-03-10T11:00:05Z"


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        ([], {}, "there is none"),
        (["a.png"], {"fit_lens": True}, "--fit-lens needs several images"),
        (["a.png"], {"fit_readout": True, "utc": UTC}, "--fit-readout needs --flight and --utc"),
        (["a.png"], {"extinction": 11.0}, "magnitude per air mass from 0 to 10, not '11.0'"),
        (["a.png"], {"extinction": "fit", "geometry_only": True}, "--extinction belongs to the brightness"),
        (["a.png", "b.png"], {"geometry_only": True}, "needs --fit-lens"),
        (["a.png", "b.png"], {"shape": True}, "--shape takes one image"),
        (["a.png", "b.png"], {"gamma": "fit"}, "--gamma fit takes one image"),
        (["a.png", "b.png"], {"gamma": None}, "--gamma fit takes one image"),
        (["a.png", "b.png"], {"labels": "stars.csv"}, "--labels belong to one image"),
        (["a.png", "b.png"], {"criterion": "paper"}, "--criterion paper"),
        (["a.png", "b.png", "c.png"], {"exposure_s": [0.5, 1.0]}, "given 2 times for 3 images"),
        (["a.png", "b.png"], {"utc": UTC}, "given 1 times for 2 images"),
        ("a.png", {"flight": "flight.BIN"}, "--flight needs --utc"),
        (Path("a.png"), {"utc": UTC, "attitude_deg": (0, 0, 0)}, "an attitude needs --utc, --lat and --lon"),
    ],
)
def test_inputs_that_contradict_each_other_are_refused(images, options, message) -> None:
    with pytest.raises(gs.ConfigError, match=message):
        gs.calibrate_photographs(images, fov_deg=40.0, **options)


def test_one_exposure_is_that_of_all_images_and_images_without_inputs_share_their_stars() -> None:
    one, other = inputs_of(2, fov_deg=40.0, exposure_s=0.5)

    assert (one.given_exposure_s, other.given_exposure_s) == (0.5, 0.5)
    assert one.reference is other.reference
    assert not one.focal_is_known
    assert one.solution(gs.Camera(80, 60, 100.0, 100.0, 39.5, 29.5)) is None


def test_an_attitude_over_a_site_gives_a_solution_and_the_config_its_focal_length() -> None:
    size = {"camera.width_px": 80, "camera.height_px": 60, "camera.fx_px": 100.0, "camera.fy_px": 100.0}
    config = gs.Config().override(**size)
    [inputs] = inputs_of(1, config=config, utc=UTC, site_deg=PLACE, attitude_deg=(70.0, 3.0, -4.0))

    assert inputs.focal_is_known
    assert inputs.solution(config.camera()) is not None


def test_notes_are_left_out_by_their_kind_whatever_their_text() -> None:
    notes = tuple(Note(kind, "the stars have wings") for kind in NoteKind)

    kept = notes_without(notes, SHAPE_NOTES)

    assert {note.kind for note in kept} == set(NoteKind) - SHAPE_NOTES
    assert SHAPE_NOTES < MODEL_NOTES
    assert str(kept[0]) == "the stars have wings"


def photo_with_exif(
    path: Path, *, latitude_deg: float, longitude_deg: float, zone: bytes | None = b"+09:30"
) -> StarPhoto:
    """Write a photograph over Adelaide, taken in the zone +09:30, whose EXIF states some place."""
    photo = StarPhoto.of(
        Sensor(reference_peak_dn=150.0, psf_sigma_px=1.2, sky_mean_dn=10.0, sky_std_dn=1.0, bit_depth=8)
    )
    start = datetime.fromtimestamp(photo.exposure.start_utc_s, timezone(timedelta(hours=9, minutes=30)))
    exif = {
        piexif.ExifIFD.DateTimeOriginal: start.strftime("%Y:%m:%d %H:%M:%S").encode(),
        piexif.ExifIFD.SubSecTimeOriginal: f"{start.microsecond:06d}".encode(),
        piexif.ExifIFD.ExposureTime: (1, 2),
        **({} if zone is None else {piexif.ExifIFD.OffsetTimeOriginal: zone}),
    }
    gps = {
        piexif.GPSIFD.GPSLatitudeRef: b"N" if latitude_deg > 0 else b"S",
        piexif.GPSIFD.GPSLatitude: ((round(abs(latitude_deg) * 10000), 10000), (0, 1), (0, 1)),
        piexif.GPSIFD.GPSLongitudeRef: b"E" if longitude_deg > 0 else b"W",
        piexif.GPSIFD.GPSLongitude: ((round(abs(longitude_deg) * 10000), 10000), (0, 1), (0, 1)),
    }
    block = piexif.dump({"Exif": exif, "GPS": gps})
    Image.fromarray(photo.image.pixels_dn.astype(np.uint8)).save(path, exif=block)
    return photo


def test_time_and_place_of_exif_are_used(tmp_path: Path) -> None:
    photo = photo_with_exif(tmp_path / "one.png", latitude_deg=-34.93, longitude_deg=138.6)
    result = gs.calibrate_photographs(tmp_path / "one.png", fov_deg=40.0, geometry_only=True)

    assert isinstance(result, GeometryCalibration)
    assert result.reference.C_ned_eq is not None
    assert any(str(note).startswith("time by EXIF, zone +09:30: ") for note in result.notes)
    assert any("place by EXIF: -34.9300, 138.6000 deg" in str(note) for note in result.notes)
    # As with the true time and place: refraction would make it 0.03 % too short.
    assert abs(result.matches.solution.camera.fx_px / photo.lens.fx_px - 1) < 1.5e-4


def test_a_wrong_place_of_exif_is_not_used(tmp_path: Path) -> None:
    photo = photo_with_exif(tmp_path / "one.png", latitude_deg=34.93, longitude_deg=-41.4)
    result = gs.calibrate_photographs(tmp_path / "one.png", fov_deg=40.0, geometry_only=True)

    assert isinstance(result, GeometryCalibration)
    assert abs(result.matches.solution.camera.fx_px / photo.lens.fx_px - 1) < 1e-3
    assert any("the stars are not those over the time and place of its EXIF" in str(note) for note in result.notes)


def test_a_time_without_a_zone_is_not_used_and_said(tmp_path: Path) -> None:
    photo_with_exif(tmp_path / "one.png", latitude_deg=-34.93, longitude_deg=138.6, zone=None)
    result = gs.calibrate_photographs(tmp_path / "one.png", fov_deg=40.0, geometry_only=True)

    assert any("its EXIF has a time without a zone, which is not used" in str(note) for note in result.notes)


def test_what_is_given_is_preferred_to_exif_and_one_image_without_time_does_not_take_that_of_another() -> None:
    exif = Exif(utc_s=parse_utc(UTC), zone="zone +00:00", exposure_s=0.5, site_deg=(10.0, 20.0))
    first, second = inputs_of(2, fov_deg=40.0, exif=[exif, Exif()])
    given, _ = inputs_of(2, fov_deg=40.0, utc=[UTC, UTC], site_deg=PLACE, exif=[exif, exif])
    [elsewhere] = inputs_of(1, fov_deg=40.0, site_deg=PLACE, exif=[exif])

    assert first.reference.stars.C_ned_eq is not None
    assert second.reference.stars.C_ned_eq is None
    assert given.reference.notes == ()
    assert [str(note) for note in elsewhere.reference.notes] == [
        "time by EXIF, zone +00:00: 2024-03-10T11:00:05.250000Z"
    ]
    # The zenith is at the latitude of the site.
    assert np.rad2deg(np.arcsin(first.reference.stars.zenith_eq[2])) == pytest.approx(10.0, abs=0.2)
    assert np.rad2deg(np.arcsin(given.reference.stars.zenith_eq[2])) == pytest.approx(PLACE[0], abs=0.2)
