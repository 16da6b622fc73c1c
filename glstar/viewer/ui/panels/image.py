"""The image panel: the picture with its overlays, zoom and pan by mouse, and the readout under the mouse."""

from math import ceil, degrees, floor
from typing import NamedTuple

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.render.opengl import Framebuffer
from glstar.sky.catalogue.reading import star_label
from glstar.viewer.overlays.curves import ImageRegion
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.content import Display, PanelContent, PanelPicture, Picture, WindowPlace
from glstar.viewer.picture.fitting import TrailResiduals
from glstar.viewer.picture.view import ImageView
from glstar.viewer.session.actions import select_object
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import Selection, star_at
from glstar.viewer.ui.panels.compare import residuals_of
from glstar.viewer.ui.panels.imagelayers import (
    Edges,
    draw_comparison_labels,
    draw_edged_text,
    draw_pixel_grid,
    draw_shapes,
)
from glstar.viewer.ui.theme import accent, error

# Zoom factor of a notch of the mouse wheel.
_WHEEL = 1.2
# Largest distance of a trail from the mouse at which its star is identified, screen px.
_CURSOR_PX = 8.0
# Movement of the mouse between press and release above which a click is a drag, screen px.
_CLICK_PX = 2.0
# Radius of the ring around the selected object, and half the length of the arrow towards one outside, screen px.
_SELECTED_PX = 14.0
# Margin of messages, screen px.
_MARGIN = 10.0
# Red, green, blue and opacity of the veil over a live sky that is out of date.
_VEIL = (0.45, 0.46, 0.48, 0.55)
# Red, green, blue and opacity behind the name of the selected object.
_PLATE = (0.0, 0.0, 0.0, 0.5)
# Points of an outline farther away than this are left out, screen px.
_FAR_PX = 1e5
# Opacity of the background of a message over the image.
_BANNER_OPACITY = 0.85


class ImagePanel:
    """Draws the image into the current imgui window."""

    def __init__(self, display: Display, selection: Selection) -> None:
        self._picture = PanelPicture(display)
        self._selection = selection
        # Whether pixel and star under the mouse are shown; not in pictures and videos.
        self.has_readout = True
        # The visible part of the picture: left, top, width, height in px of the window's framebuffer, and the position
        # of the panel's corner there; None if there is no picture.
        self._visible: tuple[tuple[int, int, int, int], tuple[int, int]] | None = None
        # Left, top, right and bottom of the panel, px of the framebuffer.
        self._panel_px = (0, 0, 0, 0)

    @property
    def visible_px(self) -> tuple[int, int, int, int] | None:
        """Left, top, width and height of the visible part of the picture, px of the window's framebuffer."""
        return None if self._visible is None else self._visible[0]

    @property
    def new_picture_px(self) -> tuple[int, int, int, int] | None:
        """Left, top, right and bottom of the panel, px of the framebuffer, if its picture is new; None otherwise."""
        return self._panel_px if self._picture.is_new else None

    def plain_picture(self) -> NDArray[np.uint8] | None:
        """Return the visible part of the picture without overlays.

        Returns (height, width, 3) uint8 or None: red, green, blue; None if there is no picture.
        """
        if self._visible is None:
            return None
        (left, top, width, height), (x, y) = self._visible
        return self._picture.read()[top - y : top - y + height, left - x : left - x + width]

    def paint(self, target: Framebuffer, size: tuple[int, int], colour: tuple[float, float, float]) -> None:
        """Draw the picture of this frame onto the window, or into a texture: see `PanelPicture.paint`."""
        self._picture.paint(target, size, colour)

    def draw(self, session: Session, *, labelled: bool = True, is_lowest: bool = False) -> None:
        """Draw the image, and zoom and pan with the mouse.

        `labelled`: whether the sides of a comparison have labels; `is_lowest`: whether nothing lies below the panel but
        the cleared window.
        """
        origin, available = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail()
        width, height = max(round(available.x), 1), max(round(available.y), 1)
        corner = np.array([round(origin.x), round(origin.y)], dtype=np.float64)
        draw_list = imgui.get_window_draw_list()
        shown, self._visible = session.shown, None
        if shown is None:
            _draw_centred_message(draw_list, session.status or _reading(session), corner, width, height)
            return
        view = session.view
        scale = imgui.get_io().display_framebuffer_scale.x
        session.look.resize(width * scale, height * scale)
        view.resize(*shown.size_px, width, height)
        # Mouse input first, so that this frame shows its effect.
        imgui.invisible_button("##image", ImVec2(width, height), imgui.ButtonFlags_.mouse_button_left)
        hovered = imgui.is_item_hovered()
        self._take_mouse(session, corner, hovered=hovered)
        texture = self._show(session, shown, corner, (round(width * scale), round(height * scale)), is_lowest=is_lowest)
        clip = (corner[0], corner[1], corner[0] + width, corner[1] + height)
        left, top, right, bottom = (edge * scale for edge in clip)
        self._panel_px = floor(left), floor(top), ceil(right), ceil(bottom)
        edges = view.edges(*shown.size_px)
        if texture is not None:
            _put(draw_list, texture, edges, corner, (width, height))
        self._visible = _visible(edges * scale, corner * scale, (width * scale, height * scale))
        footer = imgui.calc_text_size(_look_text(session)) if session.is_looking else ImVec2(0.0, 0.0)
        names_end = height - footer.y - 2 * _MARGIN * session.is_looking
        mark = _SelectedMark.of(session, self._selection, corner, clip, corner[1] + names_end)
        reserved = [] if mark is None else [mark.region(view, corner)]
        if session.is_looking:
            first, last = view.to_picture([[0.0, names_end], [footer.x + 2 * _MARGIN, height]]).tolist()
            reserved.append(ImageRegion(*first, *last))
        self._draw_overlays(session, draw_list, corner, clip, tuple(reserved), "" if mark is None else mark.name)
        if labelled:
            draw_comparison_labels(session, draw_list, corner, clip)
        if mark is not None:
            mark.draw(draw_list)
        if session.view.pixel_grid:
            draw_pixel_grid(session, draw_list, corner, clip)
        if session.is_looking:
            _draw_look(session, draw_list, corner, clip)
        if session.stale_s is not None:
            draw_list.add_rect_filled(ImVec2(*clip[:2]), ImVec2(*clip[2:]), imgui.get_color_u32(_VEIL))
        # No readout while the flight plays: pixels would have to be read back from the GPU in every frame.
        if hovered and self.has_readout and not session.is_playing and not imgui.is_item_active():
            _draw_readout(session, view.to_picture(_mouse() - corner))
        conditions = session.conditions
        warning = "" if conditions is None else conditions.viewing.warning
        if message := "\n".join(filter(None, (session.status, warning))):
            _banner(draw_list, message, clip)

    def _take_mouse(self, session: Session, corner: Float, *, hovered: bool) -> None:
        if session.is_looking:
            self._look_around(session, corner, hovered=hovered)
            return
        io, view = imgui.get_io(), session.view
        if hovered and io.mouse_wheel:
            view.zoom_at(_mouse() - corner, _WHEEL**io.mouse_wheel)
        if _is_dragged():
            comparison = session.comparison
            if comparison.active and comparison.mode is ComparisonMode.WIPE and session.shown is not None:
                line_px = view.to_picture(_mouse() - corner)[0] + 0.5
                comparison.wipe = float(np.clip(line_px / session.shown.size_px[0], 0.0, 1.0))
            else:
                view.pan(io.mouse_delta.x, io.mouse_delta.y)
        if hovered and imgui.is_mouse_double_clicked(0):
            view.fit()
        elif hovered and imgui.is_mouse_released(0) and not _is_dragged():
            _select_star(session, self._selection, view.to_picture(_mouse() - corner))

    def _look_around(self, session: Session, corner: Float, *, hovered: bool) -> None:
        """Turn the free camera, change its field of view, or select a star."""
        io, view, look = imgui.get_io(), session.view, session.look
        view.fit()
        at = view.to_picture(_mouse() - corner)
        if hovered and io.mouse_wheel:
            look.zoom(_WHEEL**io.mouse_wheel)
        if _is_dragged():
            look.drag(*at.tolist())
        if hovered and imgui.is_mouse_double_clicked(0) and session.scene is not None:
            look.look_at(at, session.scene)
        elif hovered and imgui.is_mouse_released(0) and not _is_dragged():
            _select_star(session, self._selection, at)
        if imgui.is_item_activated():  # last, because a double click turns the camera
            look.grab(*at.tolist())

    def _show(
        self, session: Session, shown: PanelContent, corner: Float, size_px: tuple[int, int], *, is_lowest: bool
    ) -> int | None:
        """Take the picture of this frame; return the texture to put into the panel, None if it needs none."""
        view, night, scale = session.view, session.night, imgui.get_io().display_framebuffer_scale.x
        compared = (shown.real, shown.mode, shown.wipe, shown.real_black, shown.real_gain) if shown.mode else ()
        placement = (view.zoom, *view.centre_px)
        tone = (session.stretch, shown.is_processed, night)
        inputs = (session.scene, session.image.number, *tone, size_px, placement, compared)
        picture = Picture.of(shown, view, session.stretch, size_px, scale=scale, night=night)
        return self._picture.show(picture, inputs, _place(corner, scale) if is_lowest else None)

    def _draw_overlays(
        self,
        session: Session,
        draw_list: imgui.ImDrawList,
        corner: Float,
        clip: Edges,
        reserved: tuple[ImageRegion, ...],
        selected: str,
    ) -> None:
        """Draw the overlays, with no label in a reserved part of the image, and none of the selected object."""
        scene, view = session.scene, session.view
        if scene is None or session.loaded is None or not session.shown_overlays:
            return
        first, last = view.to_picture([[0.0, 0.0], [clip[2] - clip[0], clip[3] - clip[1]]]).tolist()
        region = ImageRegion.complete(scene.camera).intersection(ImageRegion(*first, *last))
        if region.left_px >= region.right_px or region.top_px >= region.bottom_px:
            return
        residuals = residuals_of(session)
        shapes = session.loaded.overlays.shapes(
            scene,
            session.shown_overlays,
            name_vmag_limit=session.name_vmag_limit,
            pixels=session.image.tested if Overlay.SATURATED in session.shown_overlays else None,
            region=region,
            zoom=view.zoom,
            beliefs=()
            if session.is_looking
            else session.navigator.beliefs(session.loaded, session.image.simulator, scene),
            residuals=residuals if isinstance(residuals, TrailResiduals) else None,
            reserved=reserved,
            selected=selected,
        )

        def to_screen(xy_px: ArrayLike) -> Float:
            return view.to_screen(xy_px) + corner

        edges = view.edges(scene.camera.width_px, scene.camera.height_px) + corner
        (left, top), (right, bottom) = np.clip(edges, [clip[0], clip[1]], [clip[2], clip[3]]).tolist()
        draw_shapes(draw_list, shapes, to_screen, (left, top, right, bottom), night=session.night)


def _is_dragged() -> bool:
    """Return whether the last item is dragged, also in the frame of its release: a slow frame has all of a drag."""
    is_held = imgui.is_item_active() or imgui.is_item_deactivated()
    moved = imgui.get_mouse_drag_delta(0, 0.0)
    return is_held and (imgui.is_mouse_dragging(0, _CLICK_PX) or max(abs(moved.x), abs(moved.y)) >= _CLICK_PX)


def _put(draw_list: imgui.ImDrawList, texture: int, edges: Float, corner: Float, size: tuple[int, int]) -> None:
    """Draw the part of the panel's texture that the picture covers, without scaling."""
    first = np.clip(np.floor(edges[0]), 0, size)
    last = np.clip(np.ceil(edges[1]), 0, size)
    (left, top), (right, bottom) = (corner + first).tolist(), (corner + last).tolist()
    (u, v), (u_to, v_to) = (first / size).tolist(), (last / size).tolist()
    if left < right and top < bottom:
        reference = imgui.ImTextureRef(texture)
        draw_list.add_image(reference, ImVec2(left, top), ImVec2(right, bottom), ImVec2(u, v), ImVec2(u_to, v_to))


def _place(corner: Float, scale: float) -> WindowPlace | None:
    """Return where a panel is in the window; None between pixels, where imgui would put a texture."""
    first, last = imgui.get_window_draw_list().get_clip_rect_min(), imgui.get_window_draw_list().get_clip_rect_max()
    at = [float(px) * scale for px in (*corner, first.x, first.y, last.x, last.y)]
    if not all(px.is_integer() for px in at):
        return None
    left, top, *clip = map(int, at)
    return WindowPlace((left, top), (clip[0], clip[1], clip[2], clip[3]))


def _visible(
    edges: Float, corner: Float, size: tuple[float, float]
) -> tuple[tuple[int, int, int, int], tuple[int, int]] | None:
    """Return `ImagePanel._visible` for a picture with these edges in a panel, px."""
    (left, top), (right, bottom) = np.clip(np.rint(edges), 0, np.floor(size)).astype(int).tolist()
    if right <= left or bottom <= top:
        return None
    x, y = np.rint(corner).astype(int).tolist()
    return (x + left, y + top, right - left, bottom - top), (x, y)


def _mouse() -> Float:
    at = imgui.get_mouse_pos()
    return np.array([at.x, at.y])


def _draw_centred_message(draw_list: imgui.ImDrawList, text: str, corner: Float, width: int, height: int) -> None:
    wrap_px = max(width - 2 * _MARGIN, 1.0)
    size = imgui.calc_text_size(text, False, wrap_px)
    at = ImVec2(corner[0] + (width - size.x) / 2, corner[1] + (height - size.y) / 2)
    colour = imgui.get_color_u32(imgui.Col_.text_disabled)
    draw_list.add_text(imgui.get_font(), imgui.get_font_size(), at, colour, text, wrap_width=wrap_px)


def _reading(session: Session) -> str:
    return f"reading {session.loader.path.name} ..." if session.loader.path else "drop a flight log here"


def _banner(draw_list: imgui.ImDrawList, text: str, clip: Edges) -> None:
    """Write a message over the top of the image."""
    size = imgui.calc_text_size(text, wrap_width=clip[2] - clip[0] - 4 * _MARGIN)
    left, top = clip[0] + _MARGIN, clip[1] + _MARGIN
    corner = ImVec2(left + size.x + 2 * _MARGIN, top + size.y + _MARGIN)
    background = imgui.get_color_u32(imgui.Col_.popup_bg, _BANNER_OPACITY)
    draw_list.add_rect_filled(ImVec2(left, top), corner, background, 4.0)
    imgui.push_clip_rect(ImVec2(clip[0], clip[1]), ImVec2(clip[2], clip[3]), True)
    imgui.set_cursor_screen_pos(ImVec2(left + _MARGIN, top + _MARGIN / 2))
    imgui.push_text_wrap_pos(imgui.get_cursor_pos_x() + clip[2] - clip[0] - 4 * _MARGIN)
    imgui.text_colored(error(), text)
    imgui.pop_text_wrap_pos()
    imgui.pop_clip_rect()


def _look_text(session: Session) -> str:
    return f"{session.look.label}   Tab: the aircraft's camera"


def _draw_look(session: Session, draw_list: imgui.ImDrawList, corner: Float, clip: Edges) -> None:
    """Write where the free camera points, and draw the border of the aircraft's own image."""
    scene, loaded = session.scene, session.loaded
    if scene is None or loaded is None:
        return
    colour = imgui.get_color_u32(accent())
    outline = session.view.to_screen(session.look.outline_px(loaded.simulator, scene)) + corner
    far = np.abs(outline).max(axis=1, initial=0.0) > _FAR_PX
    draw_list.push_clip_rect(ImVec2(*clip[:2]), ImVec2(*clip[2:]), True)
    for (x, y), (to_x, to_y), hidden, to_hidden in zip(outline, outline[1:], far, far[1:], strict=False):
        if not (hidden or to_hidden) and np.isfinite([x, y, to_x, to_y]).all():
            draw_list.add_line(ImVec2(x, y), ImVec2(to_x, to_y), colour, 1.5)
    draw_list.pop_clip_rect()
    text = _look_text(session)
    size = imgui.calc_text_size(text)
    draw_edged_text(draw_list, clip[0] + _MARGIN, clip[3] - size.y - _MARGIN, colour, text)


def _select_star(session: Session, selection: Selection, position: Float) -> None:
    """Select the star at a position on the image; none if there is none."""
    if session.scene is None or session.loaded is None:
        return
    star = star_at(session.scene, *position.tolist(), within_px=_CURSOR_PX / min(session.view.zoom, 2.0))
    search = selection.search(session.loaded.simulator.sky.catalogue)
    select_object(session, selection, None if star is None else search.star(star.star_id))


class _SelectedMark(NamedTuple):
    """How the selected object is marked, screen px: a ring where it is, or the tip of an arrow towards it."""

    at: Float  # (2,) centre of the ring, or tip of the arrow
    towards: Float | None  # (2,) unit vector of the arrow; None for a ring
    name: str
    corner: Float  # (2,) top left of its name
    size: Float  # (2,) of its name

    @classmethod
    def of(
        cls, session: Session, selection: Selection, corner: Float, clip: Edges, names_end: float
    ) -> "_SelectedMark | None":
        """Return the mark in a panel, or None without a selected object.

        `corner` (2,), `clip`: of the panel; `names_end`: below this height a line says where the free camera points.
        """
        selected, scene, simulator = selection.selected, session.scene, session.image.simulator
        if selected is None or scene is None or simulator is None:
            return None
        place = selection.place(simulator, scene)
        if place is None:
            return None
        size = imgui.calc_text_size(selected.name)
        size_px = np.array([size.x, size.y])
        first, last = np.array(clip[:2]), np.array([clip[2], names_end]) - size_px
        towards = np.array([place.right, place.down])
        middle = (np.array(clip[:2]) + clip[2:]) / 2
        if place.on_image:
            at = session.view.to_screen([place.x_px, place.y_px]) + corner
            if clip[0] < at[0] < clip[2] and clip[1] < at[1] < clip[3]:
                beside = np.clip(at + _SELECTED_PX, first, last)
                return cls(at, None, selected.name, beside, size_px)
            towards = (at - middle) / np.linalg.norm(at - middle)
        half = (np.array(clip[2:]) - clip[:2]) / 2 - _SELECTED_PX
        tip = middle + towards * np.min(half / np.maximum(np.abs(towards), 1e-9))
        beside = tip - (_SELECTED_PX + _MARGIN) * towards - size_px * (0.5 + 0.5 * towards)
        return cls(tip, towards, selected.name, np.clip(beside, first, last), size_px)

    def region(self, view: ImageView, corner: Float) -> ImageRegion:
        """Return the part of the image that its name covers; `corner` (2,): of the panel."""
        first, last = view.to_picture([self.corner - corner, self.corner + self.size - corner]).tolist()
        return ImageRegion(*first, *last)

    def draw(self, draw_list: imgui.ImDrawList) -> None:
        """Draw the ring or the arrow, and the name."""
        colour = imgui.get_color_u32(accent())
        if self.towards is None:
            draw_list.add_circle(ImVec2(*self.at), _SELECTED_PX, colour, 0, 1.5)
        else:
            across = np.array([-self.towards[1], self.towards[0]]) * _SELECTED_PX / 2
            base = self.at - _SELECTED_PX * self.towards
            draw_list.add_triangle_filled(ImVec2(*self.at), ImVec2(*(base + across)), ImVec2(*(base - across)), colour)
        # On a plate, because beside the Moon the sky is white.
        first, last = self.corner - 2, self.corner + self.size + 2
        draw_list.add_rect_filled(ImVec2(*first), ImVec2(*last), imgui.get_color_u32(_PLATE), 3.0)
        draw_edged_text(draw_list, float(self.corner[0]), float(self.corner[1]), colour, self.name)


def _draw_readout(session: Session, position: Float) -> None:
    """Show the pixel and the star under the mouse."""
    scene, pixels = session.scene, session.image.pixels
    if scene is None or pixels is None:
        return
    x, y = position
    column, row = round(x), round(y)
    if not (0 <= column < scene.camera.width_px and 0 <= row < scene.camera.height_px):
        return
    if not imgui.begin_tooltip():
        return
    imgui.text(f"x {x:.1f}  y {y:.1f}   {pixels[row, column]} DN")
    electrons = scene.sensor.electrons
    if electrons is not None:
        count_e, snr = electrons.pixel_electrons(float(pixels[row, column]))
        imgui.text(f"{count_e:.1f} e   SNR {snr:.1f}")
    real = session.real
    if real is not None:
        imgui.text(f"real {real[1].pixels[row, column]} DN")
    star = star_at(scene, x, y, within_px=_CURSOR_PX / min(session.view.zoom, 2.0))
    if star is not None:
        label = star_label(star.catalogue, star.star_id)
        imgui.text_colored(accent(), star.name or label)
        imgui.text(f"{label + '   ' if star.name else ''}V {star.vmag:.2f}")
        imgui.text(f"altitude {degrees(star.altitude_rad):.2f} deg   azimuth {degrees(star.azimuth_rad):.2f} deg")
    imgui.end_tooltip()
