"""The calibration as a function: what contradicts itself is refused before an image is read."""

from pathlib import Path

import pytest

import glstar as gs
from glstar.calibrate.inputs import inputs_of
from glstar.calibrate.notes import MODEL_NOTES, SHAPE_NOTES, Note, NoteKind, notes_without

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
