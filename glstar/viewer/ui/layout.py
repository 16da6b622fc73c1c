"""The panels of the window: which there are, where they are at first, and what is in each."""

from collections.abc import Callable

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.viewer.flight.loaded import LoadedFlight
from glstar.viewer.flight.playhead import PlayHead
from glstar.viewer.flight.sky import SkySamples
from glstar.viewer.flight.traces import FlightLines, TimelineCurve
from glstar.viewer.session.actions import is_on
from glstar.viewer.session.keys import KEYS, AnyAction, shown_chord
from glstar.viewer.session.saving import save_comparison
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import ObjectKind, Selection
from glstar.viewer.ui.panels.compare import ComparisonPanel, FitPanel, draw_residual_figures
from glstar.viewer.ui.panels.display import DisplayPanel
from glstar.viewer.ui.panels.flight import FlightPanel
from glstar.viewer.ui.panels.image import ImagePanel
from glstar.viewer.ui.panels.object import draw_object
from glstar.viewer.ui.panels.playback import PlaybackControls
from glstar.viewer.ui.panels.settings import draw_settings
from glstar.viewer.ui.panels.timeline import Timeline
from glstar.viewer.ui.status import draw_link
from glstar.viewer.ui.theme import draw_checkbox, scaled

# Titles of the panels; imgui stores their layout by title.
_IMAGE = "Image"
_TIMELINE = "Time"
_LINK = "Link"
_SETTINGS = "Settings"
_DISPLAY = "View"
_COMPARE = "Compare"
OBJECT = "Object"
_FLIGHT = "Flight"

_PLAIN = int(imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_scroll_with_mouse)
_BARE = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_background
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_bring_to_front_on_focus
)
# Frames that imgui takes to dock a remembered layout.
_DOCKING_FRAMES = 3
# The initial layout: the fractions of the window on the right and below, and the width and the height, px, that the
# controls there need in a small window.
_RIGHT_FRACTION = 0.26
_RIGHT_PX = 300.0
_BELOW_FRACTION = 0.34
_BELOW_PX = 230.0
_NOTHING = (0.0, 0.0)


class Panels:
    """Draws the panels of a session.

    `perform`: performs an action of the table of keys; `has_layout`: whether imgui has a stored layout.
    """

    def __init__(
        self,
        session: Session,
        image: ImagePanel,
        selection: Selection,
        perform: Callable[[AnyAction], None],
        *,
        has_layout: bool,
    ) -> None:
        self._session = session
        self._image = image
        self._selection = selection
        self._perform = perform
        self._lays_out = not has_layout
        # Number of frames in which the first panel of each dock is brought to the front.
        self._fronts = _DOCKING_FRAMES
        self._docked: set[str] = set()
        self._playback = PlaybackControls()
        self._timeline: Timeline | None = None
        self._timeline_of: PlayHead | None = None
        self._lines: FlightLines | None = None
        self._image_times: tuple[object, NDArray[np.float64]] = None, np.empty(0)
        self._compare = ComparisonPanel(session.comparison)
        self._fit = FitPanel()
        self._display_settings = DisplayPanel()
        self._flight = FlightPanel()
        # The panels that share the right side, in the order of their tabs.
        self._right: dict[str, Callable[[], None]] = {
            _LINK: self._draw_link,
            _SETTINGS: lambda: draw_settings(session),
            _DISPLAY: self._draw_display,
            _COMPARE: self._draw_comparison,
            OBJECT: lambda: draw_object(session, selection),
            _FLIGHT: lambda: self._flight.draw(session),
        }

    def reset_layout(self) -> None:
        """Put the panels where they are at first, in the next frame."""
        self._lays_out = True

    def show(self, title: str) -> None:
        """Bring a panel to the front."""
        imgui.set_window_focus(title)

    def draw(self) -> None:
        """Draw all panels."""
        loaded = self._session.loaded
        if loaded is not None and loaded.lines is not self._lines:
            self._show_on_timeline(loaded)
        # Without a background of its own: the window has been cleared to its colour, and filling it a second time takes
        # a tenth of a frame on software OpenGL.
        imgui.push_style_color(int(imgui.Col_.window_bg), (0.0, 0.0, 0.0, 0.0))
        dock = imgui.dock_space_over_viewport(flags=int(imgui.DockNodeFlags_.passthru_central_node))
        imgui.pop_style_color()
        if self._lays_out:
            _lay_out(dock, list(self._right))
            self._fronts = 1
        self._draw_image_panel(dock)
        if self._begin(_TIMELINE, _PLAIN):
            self._draw_time()
        imgui.end()
        has_link = self._session.live is not None
        for title, draw in self._right.items():
            if title != _LINK or has_link:
                if self._begin(title):
                    draw()
                imgui.end()
        if self._fronts:
            # The first of the panels that share a place is in front, also with a stored layout: the panel that was in
            # front when it was stored may be empty now.
            imgui.set_window_focus(_LINK if has_link else _SETTINGS)
            self._fronts -= 1
        self._lays_out = False

    def draw_image_alone(self) -> None:
        """Draw the image over the complete window."""
        viewport = imgui.get_main_viewport()
        imgui.set_next_window_pos(viewport.pos)
        imgui.set_next_window_size(viewport.size)
        imgui.push_style_var(int(imgui.StyleVar_.window_padding), ImVec2(*_NOTHING))
        imgui.push_style_var(int(imgui.StyleVar_.window_border_size), 0.0)
        imgui.begin("##alone", None, _BARE)
        imgui.pop_style_var(2)
        self._image.draw(self._session, labelled=False, is_lowest=True)
        imgui.end()

    def _show_on_timeline(self, loaded: LoadedFlight) -> None:
        if loaded.head is not self._timeline_of or self._timeline is None:
            self._timeline = Timeline(loaded.flight, loaded.lines, grows=loaded.head.grows)
            self._timeline_of = loaded.head
        else:
            self._timeline.show(loaded.lines)
            self._timeline.show_flight(loaded.flight)
        self._lines = loaded.lines

    def _draw_link(self) -> None:
        if self._session.live is not None:
            draw_link(self._session, self._session.live)

    def _draw_display(self) -> None:
        self._display_settings.draw(self._session)
        self._draw_overlay_switches()

    def _begin(self, name: str, flags: int = 0) -> bool:
        """Begin a panel; a docked one needs no background, because the window has been cleared to its colour."""
        if name in self._docked:
            imgui.set_next_window_bg_alpha(0.0)
        visible = imgui.begin(name, None, flags)[0]
        if imgui.is_window_docked():
            self._docked.add(name)
        else:
            self._docked.discard(name)
        return visible

    def _draw_image_panel(self, dock: int) -> None:
        imgui.push_style_var(int(imgui.StyleVar_.window_padding), ImVec2(*_NOTHING))
        visible = imgui.begin(_IMAGE, None, _PLAIN | int(imgui.WindowFlags_.no_background))[0]
        imgui.pop_style_var()
        if visible:
            self._image.draw(self._session, is_lowest=_is_docked_in(dock))
        imgui.end()

    def _draw_time(self) -> None:
        session = self._session
        if session.head is None or self._timeline is None:
            return
        self._playback.draw(session.head)
        if self._playback.error is not None:
            session.notify(self._playback.error, is_error=True)
            self._playback.error = None
        self._timeline.draw(
            session.head,
            night=session.night,
            samples=self._samples(self._timeline),
            images_s=self._images_s(),
            others=session.loader.others.shown,
        )

    def _samples(self, timeline: Timeline) -> SkySamples | None:
        """Return the samples that the chosen curves need; they are computed for logs only."""
        loaded, selected = self._session.loaded, self._selection.selected
        if loaded is None or loaded.is_live or not any(curve.is_sampled for curve in timeline.curves):
            return None
        star_id = None
        if TimelineCurve.SNR in timeline.curves and selected is not None and selected.kind is ObjectKind.STAR:
            star_id = selected.star_id
        return self._session.loader.sampler.of(loaded.simulator, loaded.head.exposure_section, star_id)

    def _images_s(self) -> NDArray[np.float64]:
        """Return when the real images were taken, s from the flight's first attitude."""
        comparison, head = self._session.comparison, self._session.head
        if comparison.images is None or head is None:
            return np.empty(0)
        inputs = (id(comparison.images), comparison.ahead_s, head.origin_s)
        if self._image_times[0] != inputs:
            times_s = [comparison.log_utc_s(image) - head.origin_s for image in comparison.images]
            self._image_times = inputs, np.array(times_s)
        return self._image_times[1]

    def _draw_overlay_switches(self) -> None:
        imgui.separator_text("Overlays")
        for key in KEYS:
            if key.menu == "Overlays":
                is_shown = is_on(key.action, self._session)
                # A long label has its details in the tooltip: the panel is narrow.
                label, _, details = key.label.partition(": ")
                tooltip = f"{details + chr(10) if details else ''}key {shown_chord(key.chords[0])}"
                if draw_checkbox(label, is_shown, tooltip) != is_shown:
                    self._perform(key.action)

    def _draw_comparison(self) -> None:
        session = self._session
        if session.head is None:
            return
        real = session.real
        image = session.comparison.image_at(session.head.utc_s)
        requests = self._compare.draw(
            session.head.utc_s,
            image,
            real[1] if real is not None and real[0] is image else None,
            status=session.status if image is not None else "",
        )
        if requests.seek_utc_s is not None:
            session.head.seek(requests.seek_utc_s)
        if requests.save_view:
            save_comparison(session)
        draw_residual_figures(session)
        self._fit.draw(session)


def _is_docked_in(dock: int) -> bool:
    """Whether the current imgui window is docked in a dock, not in one that floats over others."""
    node = imgui.internal.dock_builder_get_node(imgui.get_window_dock_id()) if imgui.is_window_docked() else None
    return node is not None and imgui.internal.dock_node_get_root_node(node).id_ == dock


def _lay_out(dock: int, right_panels: list[str]) -> None:
    """Dock the panels in the initial layout: the image, time below it, the other panels on the right."""
    builder = imgui.internal
    builder.dock_builder_remove_node(dock)
    builder.dock_builder_add_node(dock, int(builder.DockNodeFlagsPrivate_.dock_space))
    builder.dock_builder_set_node_size(dock, imgui.get_main_viewport().work_size)
    size = imgui.get_main_viewport().work_size
    across, down = (
        min(max(fraction, scaled(needed_px) / px), 0.5)
        for fraction, needed_px, px in ((_RIGHT_FRACTION, _RIGHT_PX, size.x), (_BELOW_FRACTION, _BELOW_PX, size.y))
    )
    right = builder.dock_builder_split_node(dock, imgui.Dir.right, across)
    below = builder.dock_builder_split_node(right.id_at_opposite_dir, imgui.Dir.down, down)
    panels = (
        (_IMAGE, below.id_at_opposite_dir),
        (_TIMELINE, below.id_at_dir),
        *((title, right.id_at_dir) for title in right_panels),
    )
    for name, node in panels:
        builder.dock_builder_dock_window(name, node)
    builder.dock_builder_finish(dock)
