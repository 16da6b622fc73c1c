"""A photograph with its identified stars, in the current imgui window."""

from typing import Final

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.render.opengl.objects import Context, Texture
from glstar.viewer.arrowshapes import arrow_strokes, residual_scale
from glstar.viewer.comparisonview import ComparisonMode
from glstar.viewer.display import Display, PanelContent
from glstar.viewer.imageview import ImageView
from glstar.viewer.photocalibration import CalibratedPhoto
from glstar.viewer.stretch import Stretch, StretchKind

__all__ = ["PhotoPanel"]

Float = NDArray[np.float64]
Colour = tuple[float, float, float, float]

_IDENTIFIED: Final[tuple[Colour, Colour]] = ((0.38, 0.88, 0.66, 1.0), (0.9, 0.0, 0.0, 1.0))
_RESIDUAL: Final[tuple[Colour, Colour]] = ((1.0, 0.47, 0.25, 1.0), (1.0, 0.0, 0.0, 1.0))
_OTHER: Final[tuple[Colour, Colour]] = ((0.65, 0.70, 0.75, 0.55), (0.45, 0.0, 0.0, 0.8))
# Radius of a star's ring, distance of the mouse at which it is meant, and of a drag, screen px.
_RING_PX: Final = 7.0
_CURSOR_PX: Final = 10.0
_CLICK_PX: Final = 2.0
_WHEEL: Final = 1.2
# Names are written for this many of the brightest stars.
_NAMED: Final = 12
# Nine of ten arrows are at most this long, screen px.
_LONG_PX: Final = 30.0


class PhotoPanel:
    """Draws a photograph with zoom and pan, and the stars on it.

    Parameters
    ----------
    context : Context

    Attributes
    ----------
    detected_px : (n, 2) float64
        Detected stars.
    corner : (2,) float64
        Of the panel, screen px.
    """

    def __init__(self, context: Context) -> None:
        self.detected_px: Float = np.empty((0, 2))
        self.corner: Float = np.zeros(2)
        self._context = context
        self._display: Display | None = None
        self._texture: Texture | None = None
        self._view, self._stretch, self._white_dn = ImageView(), Stretch(StretchKind.ASINH), 1
        self._drawn: tuple[object, ...] = ()
        self._name = 0

    def show(self, pixels: NDArray[np.uint16], white_dn: int) -> None:
        """Show a photograph.

        Parameters
        ----------
        pixels : (height, width) uint16
        white_dn : int
        """
        self._release()
        self.detected_px = np.empty((0, 2))
        height, width = pixels.shape
        self._texture = self._context.texture(
            (width, height), 1, np.ascontiguousarray(pixels).tobytes(), alignment=1, dtype="u2"
        )
        self._white_dn, self._drawn = white_dn, ()
        self._stretch = Stretch(StretchKind.ASINH).fitted(pixels, white_dn)
        self._view = ImageView()

    def draw(
        self, result: CalibratedPhoto | None, removed_px: list[tuple[float, float]], *, night: bool
    ) -> tuple[float, float] | None:
        """Draw the photograph.

        Parameters
        ----------
        result : CalibratedPhoto or None
        removed_px : list of (float, float)
            Detections that the user has removed, px.
        night : bool

        Returns
        -------
        (float, float) or None
            The position of an identified star that the user has clicked on, px.
        """
        available = imgui.get_content_region_avail()
        size = max(round(available.x), 1), max(round(available.y), 1)
        origin = imgui.get_cursor_screen_pos()
        corner = self.corner = np.array([origin.x, origin.y])
        if self._texture is None:
            imgui.text_disabled("reading ...")
            return None
        width_px, height_px = self._texture.size
        self._view.resize(width_px, height_px, *size)
        imgui.invisible_button("##photo", ImVec2(*size), imgui.ButtonFlags_.mouse_button_left)
        imgui.set_item_key_owner(imgui.Key.mouse_wheel_y)
        hovered = imgui.is_item_hovered()
        at = np.array([imgui.get_mouse_pos().x, imgui.get_mouse_pos().y]) - corner
        clicked = self._take_mouse(at, hovered=hovered)
        draw_list = imgui.get_window_draw_list()
        reference = imgui.ImTextureRef(self._picture(size, night=night))
        draw_list.add_image(reference, origin, ImVec2(origin.x + size[0], origin.y + size[1]))
        draw_list.push_clip_rect(origin, ImVec2(origin.x + size[0], origin.y + size[1]), True)
        self._draw_marks(draw_list, corner, self.detected_px, _OTHER[night], 4.0)
        self._draw_marks(draw_list, corner, np.reshape(removed_px, (-1, 2)), _RESIDUAL[night], _RING_PX)
        chosen = None
        if result is not None:
            chosen = self._draw_stars(draw_list, corner, result, at if hovered else None, night=night)
        draw_list.pop_clip_rect()
        if chosen is None or not clicked or result is None:
            return None
        x_px, y_px = result.xy_px[chosen].tolist()
        return x_px, y_px

    def _take_mouse(self, at: Float, *, hovered: bool) -> bool:
        """Zoom and pan; return whether the user has clicked."""
        io = imgui.get_io()
        if hovered and io.mouse_wheel:
            self._view.zoom_at(at, _WHEEL**io.mouse_wheel)
        if imgui.is_item_active() and imgui.is_mouse_dragging(0, _CLICK_PX):
            self._view.pan(io.mouse_delta.x, io.mouse_delta.y)
        if hovered and imgui.is_mouse_double_clicked(0):
            self._view.fit()
            return False
        return hovered and imgui.is_mouse_released(0) and imgui.get_mouse_drag_delta(0, _CLICK_PX) == ImVec2(0, 0)

    def _picture(self, size: tuple[int, int], *, night: bool) -> int:
        """Return the texture of the visible part, drawn again if anything has changed."""
        assert self._texture is not None
        if self._display is None:
            self._display = Display(self._context)
        scale = imgui.get_io().display_framebuffer_scale.x
        drawn = (self._texture, size, scale, night, self._view.zoom, *self._view.centre_px)
        if drawn != self._drawn:
            self._drawn = drawn
            content = PanelContent(self._texture, self._white_dn, None, ComparisonMode.OFF, 0.5, 0.0, 0.0, 1.0)
            pixels = round(size[0] * scale), round(size[1] * scale)
            self._name = self._display.draw(content, self._view, self._stretch, pixels, scale=scale, night=night)
        return self._name

    def _draw_marks(
        self, draw_list: imgui.ImDrawList, corner: Float, xy_px: Float, colour: Colour, half_px: float
    ) -> None:
        """Draw crosses."""
        packed = imgui.get_color_u32(colour)
        for x, y in (self._view.to_screen(xy_px) + corner).tolist():
            draw_list.add_line(ImVec2(x - half_px, y - half_px), ImVec2(x + half_px, y + half_px), packed)
            draw_list.add_line(ImVec2(x - half_px, y + half_px), ImVec2(x + half_px, y - half_px), packed)

    def _draw_stars(
        self, draw_list: imgui.ImDrawList, corner: Float, result: CalibratedPhoto, at: Float | None, *, night: bool
    ) -> int | None:
        """Draw the identified stars with their residuals, and return the one under the mouse."""
        xy = self._view.to_screen(result.xy_px)
        ring, text = imgui.get_color_u32(_IDENTIFIED[night]), imgui.get_font_size()
        for x, y in (xy + corner).tolist():
            draw_list.add_circle(ImVec2(x, y), _RING_PX, ring)
        for star in np.argsort(result.vmag, kind="stable")[:_NAMED].tolist():
            x, y = (xy[star] + corner).tolist()
            draw_list.add_text(ImVec2(x + _RING_PX, y - text / 2), ring, result.name[star])
        towards_px = -result.residual_px  # from the detected to the predicted position
        scale = residual_scale(towards_px, 1 / self._view.zoom, _LONG_PX)
        tips = self._view.to_screen(result.xy_px + scale * towards_px)
        moved = np.any(towards_px != 0, axis=1)
        colour = imgui.get_color_u32(_RESIDUAL[night])
        for start, end in (arrow_strokes(xy[moved], tips[moved], 5.0) + corner).tolist():
            draw_list.add_line(ImVec2(*start), ImVec2(*end), colour, 1.5)
        label = f"arrows {scale:g} x: from the detected to the predicted position"
        draw_list.add_text(ImVec2(corner[0] + 6, corner[1] + 4), colour, label)
        if at is None or not len(xy):
            return None
        distance = np.linalg.norm(xy - at, axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > _CURSOR_PX:
            return None
        right_px, down_px = result.residual_px[nearest].tolist()
        imgui.set_tooltip(
            f"{result.name[nearest]}   V {result.vmag[nearest]:.2f}\n"
            f"residual {right_px:+.2f}, {down_px:+.2f} px\nclick: remove it, and solve again"
        )
        return nearest

    def _release(self) -> None:
        if self._texture is not None:
            self._texture.release()
            self._texture = None

    def close(self) -> None:
        """Release the objects on the GPU."""
        self._release()
        if self._display is not None:
            self._display.close()
            self._display = None
