"""The steps of a calibration, in order, with recorded calls in place of detection, identification and fits."""

import inspect
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate import pipeline
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.inputs import ImageReference
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.sky import GammaFit
from glstar.calibrate.pipeline import (
    CalibrationOptions,
    DetectedPhotograph,
    IdentifiedPhotograph,
    _calibrated,
    _identified,
    _naming,
    calibrate_photographs,
    calibration_files,
    camera_file,
    identified_with_readout,
    read_light,
)
from glstar.camera.model import Camera
from glstar.errors import CalibrationError, ConfigError
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
NOTE = Note(NoteKind.CAMERA, "of the reference")
OWN = Note(NoteKind.IDENTIFICATION, "of the matches")


def matches(count: int = 3, **more: object) -> Matches:
    index = np.arange(count)
    usual = {"star": index, "detection": index, "residual_px": np.zeros((count, 2)), "predicted": index}
    solution = PlateSolution(CAMERA, TURN)
    return Matches(**{"solution": solution, "predicted_xy_px": np.zeros((count, 2)), "chance": 0.0, **usual} | more)


def image(name: str = "a.png", **more: object) -> Photograph:
    return Photograph(Path(name), np.zeros((480, 640)), 8, "grey", 0.5, **more)


def stars_of(rows: RowTurns | None = None) -> ReferenceStars:
    return ReferenceStars("stars", np.zeros(3), np.zeros(3), 0.0, None, rows)


def reference(**more: object) -> ImageReference:
    usual = {"stars": stars_of(), "C_body_ned": None, "catalogue": "catalogue", "notes": (NOTE,), "is_by_exif": False}
    return ImageReference(**usual | more)


def identified(name: str = "a.png", **more: object) -> IdentifiedPhotograph:
    usual = {"image": image(name), "exposure_s": 0.25, "detected": f"stars of {name}", "reference": reference()}
    return IdentifiedPhotograph(**usual | {"method": "by labels", "matches": matches(notes=(OWN,))} | more)


def refused(count: int, options: CalibrationOptions, **given: bool) -> str:
    with pytest.raises(ConfigError) as caught:
        options.require_consistent(count, **{"has_times": False, "has_labels": False} | given)
    return str(caught.value)


def test_options_that_belong_together_are_accepted() -> None:
    for count, options, given in (
        (1, {}, {}),
        (2, {}, {}),
        (1, {"fit_readout": True}, {"has_times": True}),
        (1, {"extinction": "fit"}, {}),
        (1, {"extinction": "0"}, {}),
        (2, {"extinction": "10"}, {}),
        (1, {"geometry_only": True, "shape": True, "gamma": "fit", "criterion": "paper"}, {"has_labels": True}),
        (2, {"geometry_only": True, "fit_lens": True}, {}),
    ):
        CalibrationOptions(**options).require_consistent(count, **{"has_times": False, "has_labels": False} | given)
    for extinction in ("10.4", "-0.1", "clear", "nan"):
        assert refused(1, CalibrationOptions(extinction=extinction)) == (
            f"--extinction is none, fit or a magnitude per air mass from 0 to 10, not {extinction!r}"
        )
    assert "leave --twin and --geometry-only out" in refused(1, CalibrationOptions(extinction="1", geometry_only=True))
    assert refused(1, CalibrationOptions(fit_lens=True)).startswith("--fit-lens needs several images")
    assert refused(0, CalibrationOptions()) == "a calibration needs a photograph, and there is none"
    assert refused(1, CalibrationOptions(fit_readout=True)).startswith("--fit-readout needs --flight and --utc")
    assert refused(2, CalibrationOptions(), has_labels=True).startswith("--labels belong to one image")
    assert CalibrationOptions(extinction="fit").extinction_mag is None
    assert CalibrationOptions(extinction="0.25").extinction_mag == 0.25
    default = CalibrationOptions()
    assert (default.channel, default.bit_depth, default.gamma, default.criterion, default.lens) == (
        *("value", None, "linear", "median", "auto"),
    )
    assert (default.fit_lens, default.fit_readout, default.geometry_only, default.shape, default.extinction) == (
        *(False, False, False, False, "none"),
    )


@dataclass(frozen=True)
class Step:
    """What a recorded step returns: the names of all steps."""

    steps: tuple[str, ...]
    notes: tuple[Note, ...] = ()

    def then(self, name: str) -> "Step":
        return Step((*self.steps, name))


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Record the calls of one photograph's calibration."""
    calls: list[tuple[object, ...]] = []

    def fitted(detected, stars, found, *, lens):
        calls.append(("lens", detected, stars, lens))
        return replace(found, needed=7)

    def geometry(photo, detected, stars, found, *, method):
        calls.append(("geometry", found.needed, found.notes, method))
        return Step(("geometry",), (OWN,))

    def calibrate(photo, detected, stars, found, *, method, exposure_s, criterion):
        calls.append(("sensor", found.notes, method, exposure_s, criterion))
        return Step(("sensor",))

    monkeypatch.setattr(pipeline, "fit_lens", fitted)
    monkeypatch.setattr(pipeline, "calibrate_geometry", geometry)
    monkeypatch.setattr(pipeline, "calibrate", calibrate)
    monkeypatch.setattr(pipeline, "above_air", lambda part, mag: part.then(f"above air of {mag}"))
    monkeypatch.setattr(pipeline, "with_air_noted", lambda part: part.then("air noted"))
    monkeypatch.setattr(pipeline, "with_point_spread", lambda part: part.then("shape"))
    return calls


def test_a_photograph_gets_its_lens_its_geometry_and_its_sensor(steps) -> None:
    part = identified()
    plain = part.calibrated(CalibrationOptions(criterion="paper", lens="fisheye"))
    notes = (OWN, NOTE)
    assert steps == [
        ("lens", "stars of a.png", part.reference.stars, "fisheye"),
        ("geometry", 7, notes, "by labels"),
        ("sensor", notes, "by labels", 0.25, "paper"),
    ]
    assert plain.steps == ("sensor", "air noted")
    steps.clear()
    shape, fit, given = (
        CalibrationOptions(**o) for o in ({"shape": True}, {"extinction": "fit"}, {"extinction": "0.3"})
    )
    assert part.calibrated(shape, lens_is_fitted=True).steps == ("sensor", "air noted", "shape")
    assert steps[0] == ("geometry", 0, notes, "by labels")
    assert part.calibrated(fit).steps == ("sensor", "above air of None")
    assert part.calibrated(given, is_only=True).steps == ("sensor", "above air of 0.3")
    assert part.calibrated(given, is_only=False).steps == ("sensor",)
    assert part.calibrated(CalibrationOptions(), is_only=False).steps == ("sensor", "air noted")
    steps.clear()
    assert part.calibrated(CalibrationOptions(geometry_only=True)).steps == ("geometry",)
    assert [name for name, *_ in steps] == ["lens", "geometry"]


def test_a_photograph_without_a_sensor_has_its_geometry_and_the_reason(steps, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments, **more):
        raise CalibrationError("too few stars")

    monkeypatch.setattr(pipeline, "calibrate", refuse)
    part = identified()
    geometry = part.calibrated(CalibrationOptions())
    reason = Note(NoteKind.SENSOR, "camera and attitude only, no sensor: too few stars")
    assert (geometry.steps, geometry.notes) == (("geometry",), (reason, OWN))
    for options, is_only in ((CalibrationOptions(), False), (CalibrationOptions(extinction="fit"), True)):
        with pytest.raises(CalibrationError, match="too few stars"):
            part.calibrated(options, is_only=is_only)
    assert {name for name, *_ in steps} == {"lens", "geometry"}


def test_the_zenith_is_found_by_refraction(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def find(*arguments, refraction_scale):
        calls.append((arguments, refraction_scale))
        return "with zenith"

    monkeypatch.setattr(pipeline, "find_zenith", find)
    part = identified(reference=reference(refraction_scale=0.9))
    found = part.with_zenith()
    assert calls == [(("stars of a.png", part.reference.stars, part.matches), 0.9)]
    assert (found.reference.stars, found.reference.notes, found.image) == ("with zenith", (NOTE,), part.image)


def detected(given: PlateSolution | None = None, **inputs: object) -> DetectedPhotograph:
    usual = {"labels": None, "solution": lambda camera: given, "reference": reference(), "focal_is_known": True}
    photo = image(notes=("left-aligned",))
    return DetectedPhotograph(photo, 0.5, CAMERA, "stars", SimpleNamespace(**usual | inputs))


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Record how stars are identified."""
    calls: list[tuple[object, ...]] = []

    def recorded(name: str):
        def search(*arguments, **more):
            calls.append((name, *arguments, more))
            return matches(notes=(OWN,))

        return search

    for name in ("identify_by_labels", "identify_lost", "identify_near"):
        monkeypatch.setattr(pipeline, name, recorded(name))
    return calls


def test_stars_are_identified_by_labels_by_attitude_or_by_their_pattern(searches) -> None:
    given = PlateSolution(CAMERA, TURN)
    as_read = Note(NoteKind.CAMERA, "left-aligned")
    stars = reference().stars
    for inputs, method, call in (
        ({"labels": []}, "by labels", ("identify_by_labels", "stars", [], CAMERA, {"focal_known": True})),
        ({"solution": lambda camera: None}, "by their pattern", ("identify_lost", "stars", "catalogue", CAMERA, {})),
        ({"focal_is_known": False}, "by attitude", ("identify_near", "stars", given, {"focal_known": False})),
    ):
        searches.clear()
        part = detected(given, **inputs).identified()
        [(name, found, over, *rest)] = searches
        assert (name, found, *rest) == call
        assert over.zenith_eq.tolist() == stars.zenith_eq.tolist()
        assert (part.method, part.matches.notes, part.exposure_s, part.detected) == (
            method,
            (OWN, as_read),
            0.5,
            "stars",
        )


def test_a_readout_time_is_that_of_the_rows(searches) -> None:
    rows = RowTurns("attitude", 5.0, np.eye(3), 0.01, "up")
    part = detected(reference=reference(stars=stars_of(rows))).identified(0.02)
    assert part.reference.stars.rows.readout_s == searches[0][2].rows.readout_s == 0.02
    assert detected(reference=reference(stars=stars_of(rows))).identified().reference.stars.rows is rows
    assert detected().identified(0.02).reference.stars.rows is None


def test_a_wrong_place_of_exif_is_left_out(searches, monkeypatch: pytest.MonkeyPatch) -> None:
    by_exif = replace(stars_of(), zenith_eq=np.array([0.0, 0.6, 0.8]))

    def search(found, stars, catalogue, camera):
        if stars.zenith_eq.any():
            raise CalibrationError("not over this place")
        return matches()

    monkeypatch.setattr(pipeline, "identify_lost", search)
    part = detected(reference=reference(stars=by_exif, is_by_exif=True)).identified()
    assert "which are not used: is its clock right?" in str(part.reference.notes[0])
    with pytest.raises(CalibrationError, match="not over this place"):
        detected(reference=reference(stars=by_exif)).identified()


def test_an_attitude_off_by_a_fiftieth_of_a_degree_is_noted() -> None:
    for off_deg, expected in ((0.0196, ()), (0.0204, ("0.02",)), (1.5, ("1.50",))):
        # Turns about the axis are not noted.
        turn = about_z(0.7) @ matrix_from_quaternion(quaternion_from_turn([np.deg2rad(off_deg), 0.0, 0.0]))
        notes = detected(PlateSolution(CAMERA, turn @ TURN)).attitude_notes(matches())
        texts = [f"the given attitude points {number} deg away from the camera's direction" for number in expected]
        assert notes == tuple(Note(NoteKind.ATTITUDE, text) for text in texts)
    assert detected(None).attitude_notes(matches()) == ()
    assert detected(PlateSolution(CAMERA, np.eye(3)), labels=[]).attitude_notes(matches()) == ()


@pytest.mark.parametrize(("gamma", "curve", "result", "notes"), [
    ("linear", 2.0, "linear", []),
    ("2.2", 2.0, 2.2, []),
    ("fit", 2.0, 2.0, ["the noise of the sky allows gammas from 0.50 to 3.25; the least curve is taken, --gamma 2.00"]),
    (None, 1.804, 1.8, ["the noise of the sky allows gammas from 0.50 to 3.25; the least curve is taken,"
                        " --gamma 1.80"]),
    ("fit", 1.0, "linear", ["the noise of the sky allows gammas from 0.50 to 3.25: the image is taken as linear; if it"
                            " is processed, give --gamma srgb or 2.2"]),
    (None, 1.0, "linear", []),
])  # fmt: skip
def test_the_light_is_without_the_given_or_the_fitted_tone_curve(gamma, curve, result, notes, monkeypatch) -> None:
    calls, said = [], []

    def read(path, *, channel, bit_depth):
        calls.append((path, channel, bit_depth))
        return image()

    monkeypatch.setattr(pipeline, "read_image", read)
    monkeypatch.setattr(pipeline, "detect_stars", lambda photo: "stars")
    monkeypatch.setattr(pipeline, "fit_gamma", lambda photo, stars: GammaFit(curve, 0.5, 3.25))
    options = CalibrationOptions(channel="green", bit_depth=12, gamma=gamma)
    assert read_light(Path("a.png"), options, said.append).gamma == result
    assert (calls, said) == ([(Path("a.png"), "green", 12)], notes)
    assert read_light(Path("a.png"), options).gamma == result


def test_photographs_are_read_detected_and_identified_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    done, order = [], []
    monkeypatch.setattr(pipeline, "read_light", lambda path, options, on_note: image(path.name))
    monkeypatch.setattr(pipeline, "detect_stars", lambda photo: order.append(photo.path.name) or "stars")
    monkeypatch.setattr(DetectedPhotograph, "identified", lambda one: (one.image.path.name, one.exposure_s))
    monkeypatch.setattr(pipeline, "identified_with_readout", lambda photos, lens: (len(photos), lens))
    inputs = [SimpleNamespace(exposure_s=lambda photo, s=s: s, camera=lambda photo: CAMERA) for s in (0.5, 0.7)]
    paths = [Path("a.png"), Path("b.png")]
    found = _identified(paths, inputs, CalibrationOptions(), done.append, print)
    assert found == [("a.png", 0.5), ("b.png", 0.7)]
    assert (done, order) == ([0, 1, 2, 3, 4, 5, 6], ["a.png", "b.png"])
    only_geometry = _identified(paths, inputs, CalibrationOptions(geometry_only=True), done.append, print)
    assert [exposure_s for _, exposure_s in only_geometry] == [0.0, 0.0]
    options = CalibrationOptions(fit_readout=True, lens="none")
    assert _identified(paths, inputs, options, done.append, print) == (2, "none")


def test_errors_name_the_image_if_there_are_several() -> None:
    one, other = Path("a.png"), Path("b.png")

    def raised(paths: list[Path], error: CalibrationError) -> CalibrationError:
        with pytest.raises(CalibrationError) as caught, _naming(one, paths):
            raise error
        return caught.value

    plain = CalibrationError("bad", stars_used=3, stars_needed=9)
    assert raised([one], plain) is plain
    named = raised([one, other], plain)
    assert (named.path, named.stars_used, named.stars_needed) == (str(one), 3, 9)
    assert str(named) == "a.png: bad"
    of_other = CalibrationError("bad", path=other)
    assert raised([one, other], of_other) is of_other


def test_a_readout_time_is_searched_with_the_images_that_are_identified(monkeypatch: pytest.MonkeyPatch) -> None:
    attitude = Note(NoteKind.ATTITUDE, "off")
    times: list[float | None] = []

    class Photo:
        def __init__(self, name: str, *, at_once: bool = True) -> None:
            self.image, self.at_once = image(name), at_once

        def identified(self, readout_s: float | None = None) -> IdentifiedPhotograph:
            times.append(readout_s)
            if readout_s is None and not self.at_once:
                raise CalibrationError("unknown")
            return identified(self.image.path.name)

        def attitude_notes(self, found: Matches) -> tuple[Note, ...]:
            return (Note(NoteKind.ATTITUDE, f"of {found.needed}"),)

    searched, fits = [], []

    def fit(names, found, stars, given, *, lens):
        fits.append((names, found, lens))
        time = SimpleNamespace(summary="20 ms")
        fitted = [replace(one, notes=(attitude, OWN), needed=k) for k, one in enumerate(given, 5)]
        return SimpleNamespace(time=time, reference=["stars a", "stars b"][: len(names)], matches=fitted)

    monkeypatch.setattr(pipeline, "search_readout", lambda found, stars, given: searched.append(found) or 0.02)
    monkeypatch.setattr(pipeline, "fit_readout_time", fit)
    first, second = identified_with_readout([Photo("a.png", at_once=False), Photo("b.png")], "fisheye")
    assert times == [None, None, 0.02, 0.02]
    assert searched == [["stars of b.png"]]
    assert fits == [(["a.png", "b.png"], ["stars of a.png", "stars of b.png"], "fisheye")]
    assert (first.reference.stars, second.reference.stars) == ("stars a", "stars b")
    assert first.reference.notes == (NOTE, Note(NoteKind.CAMERA, "20 ms"))
    # The attitude was judged with another readout time.
    assert first.matches.notes == (OWN, Note(NoteKind.ATTITUDE, "of 5"))
    assert second.matches.notes == (OWN, Note(NoteKind.ATTITUDE, "of 6"))
    with pytest.raises(CalibrationError, match=r"c\.png: unknown"):
        identified_with_readout([Photo(f"{name}.png", at_once=False) for name in "abc"], "auto")
    assert len(identified_with_readout([Photo("a.png"), Photo("b.png", at_once=False)], "auto")) == 2


class Sensor(SimpleNamespace):
    """In place of `Calibration`."""


class Geometry(SimpleNamespace):
    """In place of `GeometryCalibration`."""


class Shared(SimpleNamespace):
    """In place of `SharedGeometry`."""


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Record the calibration of several photographs."""
    calls: list[tuple[object, ...]] = []

    def calibrated(photograph, options, *, is_only, lens_is_fitted):
        calls.append((photograph.image.path.name, photograph.matches.needed, is_only, lens_is_fitted))
        return (Geometry if options.geometry_only else Sensor)(name=photograph.image.path.name)

    def shared(names, found, stars, given, *, lens):
        return SimpleNamespace(names=names, lens=lens, matches=[replace(one, needed=9) for one in given])

    monkeypatch.setattr(IdentifiedPhotograph, "with_zenith", lambda part: part)
    monkeypatch.setattr(IdentifiedPhotograph, "calibrated", calibrated)
    monkeypatch.setattr(pipeline, "fit_shared_lens", shared)
    monkeypatch.setattr(pipeline, "Calibration", Sensor)
    monkeypatch.setattr(pipeline, "GeometryCalibration", Geometry)
    monkeypatch.setattr(pipeline, "SharedGeometry", Shared)
    monkeypatch.setattr(pipeline, "share_geometry", lambda of, shared: ("geometry", [p.name for p in of], shared))
    monkeypatch.setattr(pipeline, "above_air_together", lambda of, mag: (*of, mag))
    monkeypatch.setattr(pipeline, "combine", lambda of, *, shared_lens: ("combined", of, shared_lens))
    return calls


def test_photographs_are_calibrated_one_by_one_and_combined(parts) -> None:
    done: list[int] = []
    both = [identified("a.png"), identified("b.png")]
    kind, of, shared = _calibrated(both, CalibrationOptions(), done.append)
    assert (kind, [part.name for part in of], shared) == ("combined", ["a.png", "b.png"], None)
    assert parts == [("a.png", 0, False, False), ("b.png", 0, False, False)]
    assert done == [7, 8, 9]
    parts.clear()
    _, of, shared = _calibrated(both, CalibrationOptions(fit_lens=True, extinction="0.3", lens="none"), done.append)
    assert parts == [("a.png", 9, False, True), ("b.png", 9, False, True)]
    assert ([part if isinstance(part, float) else part.name for part in of]) == ["a.png", "b.png", 0.3]
    assert (shared.names, shared.lens) == (["a.png", "b.png"], "none")
    options = CalibrationOptions(fit_lens=True, geometry_only=True)
    kind, names, shared = _calibrated(both, options, done.append)
    assert (kind, names, shared.lens) == ("geometry", ["a.png", "b.png"], "auto")
    parts.clear()
    done.clear()
    assert _calibrated(both[:1], CalibrationOptions(), done.append).name == "a.png"
    assert (parts, done) == ([("a.png", 0, True, False)], [4])


def test_the_function_passes_all_its_options_on(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: dict[str, object] = {}
    progress: list[tuple[int, int]] = []

    def inputs(count, **more):
        calls["inputs"] = (count, more)
        return "inputs"

    def found(paths, given, options, step, on_note):
        calls["identified"] = (paths, given, options)
        step(3)
        on_note("noted")
        return "identified"

    monkeypatch.setattr(pipeline, "read_exif", lambda path: f"exif of {path.name}")
    monkeypatch.setattr(pipeline, "inputs_of", inputs)
    monkeypatch.setattr(pipeline, "_identified", found)
    monkeypatch.setattr(pipeline, "_calibrated", lambda found, options, step: (found, options))
    names = ("fov_deg", "exposure_s", "utc", "site_deg", "attitude_deg", "flight", "labels")
    given = {"fov_deg": 40.0, "exposure_s": 0.5, "utc": ["u", "v"], "site_deg": (1, 2), "attitude_deg": (3, 4, 5)}
    notes: list[str] = []
    options = {
        "channel": "red", "bit_depth": 12, "gamma": "srgb", "criterion": "median", "lens": "fisheye", "fit_lens": True,
        "fit_readout": True,
    }  # fmt: skip
    result = calibrate_photographs(
        ["a.png", Path("b.png")], flight="f.BIN", on_step=lambda *step: progress.append(step), on_note=notes.append,
        extinction=0.25, **given, **options,
    )  # fmt: skip
    expected = CalibrationOptions(extinction="0.25", **options)
    assert result == ("identified", expected)
    assert calls["identified"] == ([Path("a.png"), Path("b.png")], "inputs", expected)
    exif = ["exif of a.png", "exif of b.png"]
    more = {"config": None, "flight": "f.BIN", "labels": None, "fit_readout": True, "exif": exif}
    assert calls["inputs"] == (2, given | more)
    assert (progress, notes) == ([(3, 9)], ["noted"])
    assert calibrate_photographs("a.png", on_step=lambda *step: progress.append(step)) == (
        *("identified", CalibrationOptions()),
    )
    assert progress[1] == (3, 4)
    assert calls["inputs"] == (
        1, dict.fromkeys((*names, "config")) | {"fit_readout": False, "exif": ["exif of a.png"]}
    )  # fmt: skip
    calibrate_photographs(Path("a.png"))
    for has_flight, utc in ((True, None), (True, []), (False, "u")):
        with pytest.raises(ConfigError, match="--fit-readout needs --flight and --utc"):
            calibrate_photographs("a.png", fit_readout=True, flight="f.BIN" if has_flight else None, utc=utc)
    with pytest.raises(ConfigError, match="--labels belong to one image"):
        calibrate_photographs(["a.png", "b.png"], labels="l.csv")
    defaults = {name: one.default for name, one in inspect.signature(calibrate_photographs).parameters.items()}
    assert (defaults["geometry_only"], defaults["shape"], defaults["extinction"]) == (False, False, "none")


def part(kind: type, name: str, count: int = 3, **more: object) -> SimpleNamespace:
    found = matches(count, standard_error={"fx_px": 0.1234, "cx_px": 2.0} if count > 3 else {})
    return kind(
        image=image(name), matches=found, to_toml=lambda: f"toml of {name}", to_json=lambda: {"of": name},
        to_csv=lambda: f"csv of {name}", **more,
    )  # fmt: skip


def test_files_of_a_calibration(parts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "draw_report", lambda one: f"report of {one.image.path.name}")
    monkeypatch.setattr(pipeline, "draw_geometry", lambda one: f"geometry of {one.image.path.name}")
    monkeypatch.setattr(pipeline, "draw_combined", lambda one: "combined")
    for kind, drawn in ((Sensor, "report of a.png"), (Geometry, "geometry of a.png")):
        assert calibration_files(part(kind, "a.png"), "night") == {
            "night.toml": b"toml of a.png",
            "night.json": b'{\n "of": "a.png"\n}\n',
            "night.stars.csv": b"csv of a.png",
            "night.png": drawn,
        }
    both = (part(Sensor, "a.png"), part(Geometry, "b.png", 5))
    table = SimpleNamespace(to_csv=lambda: "table")
    several = {"parts": both, "to_json": lambda: {"several": 2}}
    combined = SimpleNamespace(table=table, to_toml=lambda name: f"toml with {name}", **several)
    files = calibration_files(combined, "night")
    of_each = {f"night.{one}.{suffix}" for one in "ab" for suffix in ("json", "stars.csv", "png")}
    assert set(files) == of_each | {"night.toml", "night.json", "night.png", "night.brightness.csv"}
    assert files["night.b.png"] == "geometry of b.png"
    assert files["night.a.stars.csv"] == b"csv of a.png"
    assert (files["night.toml"], files["night.png"]) == (b"toml with night.brightness.csv", "combined")
    assert (files["night.brightness.csv"], files["night.json"]) == (b"table", b'{\n "several": 2\n}\n')
    files = calibration_files(Shared(to_toml=lambda: "shared", best=both[1], **several), "night")
    assert set(files) == of_each | {"night.toml", "night.json", "night.png"}
    assert (files["night.toml"], files["night.png"]) == (b"shared", "geometry of b.png")


def test_the_camera_file_is_that_of_the_most_stars(parts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "camera_to_yaml", lambda camera, *comments: (camera, comments))
    one, other = part(Sensor, "a.png"), part(Geometry, "b.png", 5)
    errors = "Standard errors: fx_px 0.12, cx_px 2."
    assert camera_file(one) == (CAMERA, ("From the stars of a.png.",))
    assert camera_file(other) == (CAMERA, ("From the stars of b.png.", errors))
    assert camera_file(SimpleNamespace(parts=(one, other, one))) == (CAMERA, ("From the stars of b.png.", errors))
