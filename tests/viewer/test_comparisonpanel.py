"""The panel of real images: what a user types and clicks, without a display and without OpenGL."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.images.times import TimeReference
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState
from glstar.viewer.ui.panels.compare import ComparisonPanel, PanelRequests

UTC_S = 1564433246.0  # 2019-07-29 20:47:26
LABELLED = ("button", "radio_button", "selectable", "checkbox", "input_text_with_hint", "tree_node", "input_double")


class Hand:
    """Draws the panel frame by frame, and clicks and types as a user does."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.state = ComparisonState()
        self.panel = ComparisonPanel(self.state)
        self.utc_s = UTC_S
        self.status = ""
        self.places: dict[str, tuple[float, float]] = {}
        self.texts: list[str] = []
        for name in LABELLED:
            monkeypatch.setattr(imgui, name, self._noting(getattr(imgui, name)))
        for name in ("text_unformatted", "text_disabled"):
            monkeypatch.setattr(imgui, name, self._noting_text(getattr(imgui, name)))

    def _noting(self, widget: Callable) -> Callable:
        def noting(label: str, *rest: object) -> object:
            answer = widget(label, *rest)
            low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
            self.places[label] = (low.x + min(10.0, (high.x - low.x) / 2), (low.y + high.y) / 2)
            return answer

        return noting

    def _noting_text(self, widget: Callable) -> Callable:
        def noting(text: str) -> None:
            self.texts.append(text)
            widget(text)

        return noting

    def frame(self) -> PanelRequests:
        self.texts.clear()
        self.state.poll()
        image = self.state.image_at(self.utc_s)
        fitted = self.state.images.fitted(image, 32, 24) if image is not None and self.state.images else None
        imgui.new_frame()
        imgui.set_next_window_pos((0, 0))
        imgui.set_next_window_size((400, 900))
        imgui.begin("Real images")
        asked = self.panel.draw(self.utc_s, image, fitted, status=self.status)
        imgui.end()
        imgui.render()
        return asked

    def until(self, reached: Callable[[], bool]) -> None:
        last = time.monotonic() + 20
        while not reached():
            assert time.monotonic() < last
            self.frame()
            time.sleep(0.005)

    def rest(self) -> None:
        """Draw frames until the layout no longer changes and the pixels are decoded."""
        self.until(lambda: "decoding ..." not in self.texts and len(self.texts) > 1)

    def click(self, label: str) -> PanelRequests:
        """Click on a widget; return the panel's request in one of the frames of the click."""
        self.places.clear()
        self.frame()
        [place] = [place for name, place in self.places.items() if name == label or label in name.split("#")[0].split()]
        io = imgui.get_io()
        io.add_mouse_pos_event(*place)
        asked = [self.frame()]
        for down in (True, False):
            io.add_mouse_button_event(0, down)
            asked += [self.frame(), self.frame()]
        return next((each for each in asked if each != PanelRequests()), PanelRequests())

    def type(self, text: str) -> None:
        io = imgui.get_io()
        io.add_input_characters_utf8(text)
        self.frame()
        for down in (True, False):
            io.add_key_event(imgui.Key.enter, down)
            self.frame()


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hand]:
    context = imgui.create_context()
    io = imgui.get_io()
    io.set_ini_filename("")
    io.display_size = imgui.ImVec2(400, 900)
    io.delta_time = 1 / 60
    io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
    hand = Hand(monkeypatch)
    yield hand
    hand.state.close()
    imgui.destroy_context(context)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for second in range(20, 50, 3):
        cv2.imwrite(str(tmp_path / f"20190729_2047{second}.png"), np.full((24, 32), second, np.uint8))
    (tmp_path / "100%done.txt").write_text("no image\n")
    return tmp_path


@pytest.fixture
def opened(hand: Hand, folder: Path) -> Hand:
    hand.state.open(folder)
    hand.until(lambda: hand.state.active)
    hand.rest()
    return hand


def test_a_typed_folder_is_opened(hand: Hand, folder: Path) -> None:
    hand.click("##folder")
    hand.type(str(folder))

    hand.until(lambda: hand.state.active)

    assert hand.state.images is not None
    assert hand.state.images.folder == folder
    hand.frame()
    assert "10 images; times: 10 by name" in hand.texts


def test_a_path_that_is_not_a_folder_is_reported(hand: Hand, tmp_path: Path) -> None:
    hand.click("##folder")
    hand.type(f"{tmp_path}/missing")

    hand.until(lambda: hand.state.opening is None)
    hand.frame()

    assert f"{tmp_path}/missing: is not a folder of images: No such file or directory" in hand.texts


def test_an_empty_path_opens_nothing(hand: Hand) -> None:
    hand.click("Open")

    assert (hand.state.opening, hand.state.error) == (None, "")


@pytest.mark.parametrize("mode", ComparisonMode)
def test_every_mode_has_its_button(opened: Hand, mode: ComparisonMode) -> None:
    opened.click(mode)

    assert opened.state.mode is mode


def test_a_clicked_image_requests_its_time_by_the_log_s_clock(opened: Hand) -> None:
    opened.state.offset_s = 0.5

    assert opened.click("20190729_204729.png") == PanelRequests(seek_utc_s=UTC_S + 3 - 0.5)


def test_the_clicked_one_of_several_simultaneous_images_is_shown(opened: Hand, folder: Path) -> None:
    cv2.imwrite(str(folder / "20190729_204729_b.png"), np.zeros((24, 32), np.uint8))
    opened.state.open(folder)
    opened.until(lambda: opened.state.images is not None and len(opened.state.images) == 11)
    opened.until(lambda: "decoding ..." not in opened.texts)

    opened.utc_s = opened.click("20190729_204729_b.png").seek_utc_s or 0.0

    shown = opened.state.image_at(opened.utc_s)
    assert shown is not None
    assert shown.path.name == "20190729_204729_b.png"


@pytest.mark.parametrize(("label", "step_s"), [("< image", -3.0), ("image >", 3.0)])
def test_the_buttons_step_through_the_images(opened: Hand, label: str, step_s: float) -> None:
    assert opened.click(label) == PanelRequests(seek_utc_s=UTC_S + step_s)


def test_the_list_follows_the_play_head(opened: Hand) -> None:
    opened.utc_s = UTC_S + 100
    for _ in range(3):
        opened.frame()
    opened.places.clear()
    opened.frame()

    assert any("20190729_204747.png" in label for label in opened.places)
    # imgui always draws the first row, also out of view, to measure the others.
    assert not any("20190729_204723.png" in label for label in opened.places)


def test_the_view_can_be_saved_once_its_pixels_are_decoded(opened: Hand) -> None:
    assert opened.click("Save this view") == PanelRequests(save_view=True)


def test_an_offset_is_typed_to_the_millisecond_and_reset(opened: Hand) -> None:
    place = opened.places["s"]
    io = imgui.get_io()
    io.add_mouse_pos_event(*place)
    opened.frame()
    for down in (True, False, True, False):  # a double click selects the complete number
        io.add_mouse_button_event(0, down)
        opened.frame()
    opened.type("-3600.125")
    assert opened.state.offset_s == -3600.125
    opened.frame()
    assert "[flight] time_offset_s = -3600.12" in [text[:33] for text in opened.texts]

    opened.rest()  # at another image
    opened.click("0")
    assert opened.state.offset_s == 0.0


def test_the_panel_keeps_other_settings(opened: Hand) -> None:
    opened.state.offset_s, opened.state.real_gain, opened.state.time_reference = -34215.0625, 1.0, TimeReference.MIDDLE

    for _ in range(3):
        opened.frame()

    assert (opened.state.offset_s, opened.state.real_gain, opened.state.time_reference) == (
        -34215.0625,
        1.0,
        TimeReference.MIDDLE,
    )


def test_unusable_files_are_listed_by_name(opened: Hand) -> None:
    opened.click("1 file not usable###problems")
    opened.frame()

    assert "100%done.txt: is not an image that glstar reads" in opened.texts


def test_the_panel_shows_why_there_is_no_simulated_image(opened: Hand) -> None:
    opened.status = "the real image begins 9.5 h before the flight"
    opened.frame()

    assert opened.status in opened.texts
