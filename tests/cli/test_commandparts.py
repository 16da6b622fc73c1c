"""Parts of commands that need no other process: what they refuse, what they note, and the words that they print."""

import time
from math import degrees, radians
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import numpy as np
import pytest
import typer
from scipy.stats import chi2

from glstar import cli
from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.cli import dispatch
from glstar.cli.calibration.camera import _description
from glstar.cli.flights import linkcommands
from glstar.cli.images import demo, export
from glstar.cli.images.exportoptions import FramePublishing
from glstar.cli.machine import catalogue, doctor
from glstar.cli.reporting import Verbosity, _lines, echo_detail, echo_note, reporting, verbosity
from glstar.config import Config
from glstar.errors import CatalogueError
from glstar.export.run import prepare
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide


def test_brackets_of_a_help_are_escaped_once_and_other_text_stays() -> None:
    shared = typer.Option(help="A table [sweep].")
    plain = typer.Option(help="No brackets.")
    app = typer.Typer()

    @app.command()
    def one(a: Annotated[int, shared] = 1, b: Annotated[int, plain] = 2) -> None:
        """Do [this]."""

    @app.command()
    def two(a: Annotated[int, shared] = 1) -> None:
        """Do that."""

    cli._complete(app)
    assert shared.help == "A table \\[sweep]."
    assert plain.help == "No brackets."
    assert [command.help for command in app.registered_commands] == ["Do \\[this].", "Do that."]


def test_a_help_has_arguments_before_options_and_unknown_panels_among_those_of_the_report() -> None:
    def parameter(kind: str, panel: str | None) -> SimpleNamespace:
        return SimpleNamespace(param_type_name=kind, rich_help_panel=panel)

    panels = dispatch.PANELS
    options = [parameter("option", panel) for panel in reversed(panels)]
    parameters = [*options, parameter("argument", None), parameter("option", None)]
    ordered = sorted(parameters, key=dispatch._place)
    assert ordered[0].param_type_name == "argument"
    named = [one.rich_help_panel for one in ordered[1:] if one.rich_help_panel is not None]
    assert named == list(panels)
    report = [dispatch._place(one) for one in parameters if one.rich_help_panel in (None, dispatch.REPORT)]
    assert len(set(report[:-2] + report[-1:])) == 1


def test_a_column_has_a_quantity_a_sign_and_a_name() -> None:
    assert catalogue._column_map(["vmag=V", "name=a=b"]) == {"vmag": "V", "name": "a=b"}
    for wrong in ("vmag", "vmag=", "=V", "="):
        with pytest.raises(typer.BadParameter, match="is not QUANTITY=NAME"):
            catalogue._column_map([wrong])


@pytest.mark.parametrize(("is_checkout", "is_writable"), [(True, True), (True, False), (False, True), (False, False)])
def test_the_bundled_catalogue_is_replaced_in_a_checkout_that_can_be_written(
    is_checkout: bool, is_writable: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if is_checkout:
        (tmp_path / "pyproject.toml").touch()
    path = tmp_path / "assets" / "bsc5.sqlite"
    monkeypatch.setattr(catalogue, "catalogue_path", lambda _: path)
    monkeypatch.setattr(catalogue.os, "access", lambda *_: is_writable)
    if is_checkout and is_writable:
        assert catalogue._home(catalogue._Name.BSC5) == path
    else:
        with pytest.raises(CatalogueError, match="is part of the installation"):
            catalogue._home(catalogue._Name.BSC5)
    assert catalogue._home(catalogue._Name.GAIA) == path


@pytest.mark.parametrize("width_px", [507, 4056])
def test_the_cameras_of_doctor_have_the_field_of_the_bundled_one(
    width_px: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def prepared(config: Config, *_: object) -> None:
        raise InterruptedError(config.camera())

    monkeypatch.setattr(prepare, "prepare_export", prepared)
    with pytest.raises(InterruptedError) as ended:
        doctor._rates_of(None, width_px, 0.1, tmp_path)
    found, bundled = ended.value.args[0], Config().camera()
    assert (found.width_px, found.height_px) == (width_px, width_px * 3040 // 4056)
    assert found.width_px / found.fx_px == pytest.approx(bundled.width_px / bundled.fx_px)
    assert found.fy_px == found.fx_px


def test_a_rate_is_that_of_the_seconds_that_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, done = [100.0], []
    monkeypatch.setattr(doctor.time, "perf_counter", lambda: now_s[0])

    def work(number: int) -> None:
        now_s[0] += 0.25
        done.append(number)

    assert doctor._rate(work, 3, 2.0) == 4.0
    # Once before the clock starts, and then for two seconds.
    assert done == [0, 0, 1, 2, 0, 1, 2, 0, 1]


@pytest.mark.parametrize(("margin_deg", "is_ground"), [(0.5, False), (-0.5, True)])
def test_a_frame_shows_only_the_ground_if_its_corners_are_below_the_horizon(margin_deg: float, is_ground: bool) -> None:
    lens = camera(320, 240, 300.0)
    down_rad = radians(margin_deg) - lens.field_radius_rad
    simulator = sky_over_adelaide(lens, mount=Mount(0.0, 0.0, 0.0), vmag_limit=3.0, pitch_rad=down_rad)
    sun_deg, sees_ground = export._sun_and_ground(
        SimpleNamespace(simulator=simulator, exposure=Exposure(NIGHT_UTC_S + 2, 0.05))
    )
    assert sees_ground == is_ground
    # Two hours after sunset in March, in degrees.
    assert -25 < sun_deg < -15


def test_notes_name_the_number_of_checked_frames_unless_all_are_meant() -> None:
    assert export._of_checked(8, 8) == "all frames"
    assert export._of_checked(3, 8) == "3 of 8 frames checked"


@pytest.mark.parametrize(
    ("where", "with_truth", "is_refused"),
    [
        ("zmq://127.0.0.1:5555", False, False),
        ("http://127.0.0.1:8000", False, False),
        ("video:out.mp4", False, False),
        ("zmq://127.0.0.1:5555", True, True),
        ("frames/latest.png", False, True),
        (None, False, False),
    ],
)
def test_a_blind_export_passes_no_truth_on(where: str | None, with_truth: bool, is_refused: bool) -> None:
    output = FramePublishing(where, with_truth)
    assert output.without_truth(None) is output
    if is_refused:
        with pytest.raises(typer.BadParameter, match="would pass on the truth"):
            output.without_truth(Path("blind"))
    else:
        assert output.without_truth(Path("blind")) is output


@pytest.mark.parametrize(
    ("workers", "dask", "draws", "problem"),
    [
        (None, None, True, None),
        (1, None, True, None),
        (2, None, True, "leave out --workers and --dask"),
        (None, "tcp://a:1", True, "leave out --workers and --dask"),
        (None, None, False, "leave out --dry-run and --verify"),
    ],
)
def test_frames_are_passed_on_by_the_process_that_draws(
    workers: int | None, dask: str | None, draws: bool, problem: str | None
) -> None:
    output = FramePublishing("zmq://127.0.0.1:5555")
    if problem is None:
        assert output.in_one_process(workers, dask, draws=draws) is output
    else:
        with pytest.raises(typer.BadParameter, match=problem):
            output.in_one_process(workers, dask, draws=draws)
    none = FramePublishing(None)
    assert none.in_one_process(workers, dask, draws=draws) is none
    with pytest.raises(typer.BadParameter, match="belongs to --latest-frame zmq"):
        FramePublishing(None, with_truth=True)


def test_the_views_of_a_camera_are_between_its_outer_edges() -> None:
    """Half of the sensor is 160 x 120 px at a focal length of 300 px."""
    text = "\n".join(_description(camera(320, 240, 300.0)))
    across, down = (2 * np.rad2deg(np.arctan(half / 300)) for half in (160, 120))
    corners = 2 * np.rad2deg(np.arctan(200 / 300))
    assert f"view {across:.2f} deg across, {down:.2f} deg down, {corners:.2f} deg corner to corner" in text
    # An equidistant lens of 120 px per radian sees 160 / 120 rad to each side: beyond 180 deg from corner to corner.
    wide = Camera(320, 240, 120.0, 120.0, 159.5, 119.5, lens=Lens("fisheye", (0.0, 0.0, 0.0, 0.0)))
    text = "\n".join(_description(wide))
    views = [f"{degrees(2 * half / 120):.2f} deg {name}" for half, name in ((160, "across"), (120, "down"))]
    assert f"{views[0]}, {views[1]}, {degrees(2 * 200 / 120):.2f} deg corner to corner" in text


def test_one_standard_deviation_of_two_components_has_its_probability() -> None:
    confidence = linkcommands._ONE_SIGMA
    assert chi2.ppf(confidence, 2) == pytest.approx(1.0, rel=1e-9)


def test_notes_and_details_depend_on_the_verbosity(capsys: pytest.CaptureFixture[str]) -> None:
    written = {}
    for quiet, verbose in ((True, False), (False, False), (False, True)):
        with reporting(quiet=quiet, verbose=verbose):
            level = verbosity()
            echo_note("a note")
            echo_detail("a detail")
        written[level] = capsys.readouterr().err.splitlines()
    assert written == {
        Verbosity.QUIET: [],
        Verbosity.NORMAL: ["a note"],
        Verbosity.VERBOSE: ["a note", "a detail"],
    }
    assert verbosity() is Verbosity.NORMAL
    with (
        pytest.raises(typer.BadParameter, match="contradict each other"),
        reporting(quiet=True, verbose=True),
    ):
        pass


def test_progress_without_a_terminal_is_a_line_every_half_minute_and_the_last(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = [50.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    on_item = _lines("frames")
    for number in range(1, 41):
        now_s[0] += 2.0
        on_item(number, 40)
    assert capsys.readouterr().err.splitlines() == [
        f"frames: {number} of 40 after {2.0 * number:.1f} s" for number in (1, 16, 31, 40)
    ]


class Text:
    """OpenCV's text: 10 px a letter and 12 px high; records what is written."""

    FONT_HERSHEY_SIMPLEX = LINE_AA = 0

    def __init__(self) -> None:
        self.written: list[tuple[str, tuple[int, int]]] = []

    def getTextSize(self, text: str, *_: object) -> tuple[tuple[int, int], int]:
        return (10 * len(text), 12), 0

    def putText(self, _: object, text: str, corner: tuple[int, int], *__: object) -> None:
        if (text, corner) not in self.written:
            self.written.append((text, corner))


def test_labels_of_the_demo_do_not_overlap_and_stay_in_their_tile() -> None:
    text = Text()
    labels = demo._Labels(text, np.zeros((100, 200), np.uint8))
    # Of 30 x 12 px; the second overlaps the first by a column or a row, the others touch it.
    for name, x, y in (("one", 50, 50), ("two", 79, 61), ("six", 21, 39), ("ten", 80, 50), ("sun", 50, 62)):
        labels.draw(name, x, y)
    labels.draw("far", 1000, 1000)
    labels.draw("low", -5, -5)
    assert text.written == [
        *[("one", (50, 50)), ("ten", (80, 50)), ("sun", (50, 62))],
        *[("far", (166, 94)), ("low", (4, 16))],
    ]


def _star(x_px: float, **changes: object) -> dict[str, object]:
    star = {"star_id": int(x_px), "in_frame": 1.0, "snr": 100.0, "centroid_x_px": x_px, "centroid_y_px": 5.0}
    return star | {"start": [x_px - 9, 5.0], "end": [x_px + 4, 5.0]} | changes


def test_the_demo_names_bright_stars_that_are_not_close_to_brighter_ones() -> None:
    far = 2 * demo._MIN_DISTANCE_PX
    near = _star(demo._MIN_DISTANCE_PX - 1)
    stars = [_star(0.0), near, _star(far), _star(2 * far, snr=None), _star(3 * far, in_frame=0.0), _star(4 * far)]
    named = [star["centroid_x_px"] for star in demo._brightest({"stars": stars})]
    assert named == [0.0, far, 4 * far]
    many = [_star(k * far) for k in range(2 * demo._NAMED_STARS)]
    assert demo._brightest({"stars": many}) == many[: demo._NAMED_STARS]
    # The end nearer to the centroid is where the star was slower.
    assert demo._brighter_end(_star(20.0)) == (24.0, 5.0)
    assert demo._brighter_end(_star(20.0, end=None)) == (11.0, 5.0)
    assert demo._brighter_end(_star(20.0, start=None, end=None)) == (20.0, 5.0)
    assert demo._spelled_out("\N{GREEK SMALL LETTER GAMMA}\N{SUPERSCRIPT TWO} Vel") == "gamma2 Vel"


@pytest.mark.parametrize(("sun_deg", "is_named"), [(-9.5, True), (-8.5, False), (None, True)])
def test_the_demo_names_bodies_in_a_dark_image(
    sun_deg: float | None, is_named: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2  # noqa: PLC0415 - only here

    drawn = []
    monkeypatch.setattr(demo._Labels, "draw", lambda _, text, x, y: drawn.append((text, x, y)))
    cv2.imwrite(str(tmp_path / "a.png"), np.full((380, 507), 60, np.uint8))
    bodies = [
        {"name": "Mars", "x_px": 100.0, "y_px": 50.0, "vmag": 1.0},
        {"name": "Uranus", "x_px": 100.0, "y_px": 50.0, "vmag": 5.8},
        {"name": "Venus", "x_px": None, "y_px": None, "vmag": -4.0},
    ]
    line = {"file": "a.png", "utc_start": "2024-03-18T08:55:00.000000Z", "duration_s": 0.25, "stars": []}
    sun = {} if sun_deg is None else {"sun_altitude_deg": sun_deg}
    tile = demo._tile(cv2, tmp_path, line | {"bodies": bodies} | sun, {})
    scale = tile.shape[1] / 507
    assert tile.shape[0] == round(380 * scale)
    assert drawn[0] == ("a.png  2024-03-18T08:55:00Z  0.25 s", 10, tile.shape[0] - 12)
    assert drawn[1:] == ([("Mars", 100 * scale + 8, 50 * scale - 8)] if is_named else [])
    # A border at the right and below, and 60 DN between black and white elsewhere.
    assert (tile[:, -1] == 90).all()
    assert (tile[-1] == 90).all()
    assert len(np.unique(tile[:-1, :-1])) == 1
    if sun_deg is not None:
        assert tile[0, 0] == pytest.approx(255 * (60 - 10) / (110 - 10), abs=1)
