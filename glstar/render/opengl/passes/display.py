"""The display pass: zoom, display stretch and comparison with a real image, from textures to a texture on the GPU."""

from dataclasses import dataclass
from math import asinh
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.textures import ImageTexture

# Screen pixels coarser than this many image pixels sum up to 2 x 2 of them, or any number: see SHRINKS in display.frag.
_SHRINK_STEPS = (1.0, 2.0)
# Of a texture whose row 0 is the top, with nothing behind the picture.
_UPRIGHT = (0.0, 0.0, 1.0, 1.0)
_CLEAR = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Placement:
    """Which part of the picture is drawn on the target, and where."""

    size: tuple[int, int]  # Width and height of the target, screen px
    # The position of the target's top-left corner on the picture, px from the picture's own top-left corner.
    corner_px: tuple[float, float]
    image_px_per_screen_px: float  # The side of a screen pixel on the picture, px
    # Left, top, width, height of the part of the target that the picture covers, screen px; the rest is not computed.
    scissor: tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Tone:
    """The display stretch; see `glstar.viewer.picture.view.Stretch`."""

    black: float  # The level shown black, as a fraction of white
    boost: float  # Gain
    softening: float  # Scale of the asinh stretch; 0 for a linear one
    colours: NDArray[np.uint8] | None  # (256, 3) uint8 or None: red, green, blue by brightness; None for shades of grey
    night: bool  # Whether to draw in shades of red


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonInput:
    """A real image of the size of the simulated one, and how it is compared."""

    pixels: NDArray[Any]  # (height, width) uint8 or uint16: uploaded again only if it is another array
    white_dn: int
    # Left, top, right, bottom of the part of `pixels` that the real image covers.
    covered_px: tuple[float, float, float, float]
    mode: int  # A constant of ``display.frag``: 1 real, 2 wipe, 3 difference, 4 side by side
    wipe: float  # Where the line between the images is, 0 to 1
    # The level subtracted from the real image, as a fraction of its white, and the gain applied to the difference.
    black: float
    gain: float
    more_rgb: tuple[float, float, float]  # The colours of positive and negative differences
    less_rgb: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class WindowPart:
    """A part of a window that a picture is drawn onto."""

    framebuffer: moderngl.Framebuffer  # Of the window; row 0 is the bottom
    size: tuple[int, int]  # Its width and height, px
    corner_px: tuple[int, int]  # Left and top of the part, px from the window's top-left corner
    clip_px: tuple[int, int, int, int]  # Left, top, right and bottom of what is drawn of it, px from the same corner
    colour: tuple[float, float, float]  # Red, green, blue behind the picture

    @property
    def screen_from_fragment_px(self) -> tuple[float, float, float, float]:
        """Offset and direction of the part's pixels, from its top-left corner, in the framebuffer's pixels."""
        left, top = self.corner_px
        return float(-left), float(self.size[1] - 1 - top), 1.0, -1.0

    def scissor(self, part: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
        """Return left, bottom, width, height in the framebuffer of a rectangle left, top, width, height of the part.

        It is cut at the edges of `clip_px`.
        """
        left = max(self.corner_px[0] + part[0], self.clip_px[0])
        top = max(self.corner_px[1] + part[1], self.clip_px[1])
        right = min(self.corner_px[0] + part[0] + part[2], self.clip_px[2])
        bottom = min(self.corner_px[1] + part[1] + part[3], self.clip_px[3])
        return left, self.size[1] - bottom, max(right - left, 0), max(bottom - top, 0)


class DisplayPass:
    """Draws developed images at the resolution of the screen, on the current context."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._screen = context.detect_framebuffer(0)
        # One program for each value of SHRINKS, COMPARES and COLOURED, compiled when it is first used.
        self._programs: dict[tuple[int, bool, bool], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        self._target: moderngl.Framebuffer | None = None
        self._texture: moderngl.Texture | None = None
        self._real = ImageTexture(context)
        self._processed = ImageTexture(context)
        self._processed_program: tuple[moderngl.Program, moderngl.VertexArray] | None = None
        self._colour_map: moderngl.Texture | None = None

    def draw(
        self,
        image: moderngl.Texture | NDArray[np.uint8],
        white_dn: int,
        placement: Placement,
        tone: Tone,
        compared: ComparisonInput | None = None,
    ) -> int:
        """Draw the picture and return the OpenGL name of its texture, which is valid until the size changes.

        `image` is a developed one of one unsigned integer component, or (height, width, 3) uint8: red, green and blue
        of a processed one, which is shown without stretch and comparison.  Row 0 is the top; `white_dn` is its largest
        digital number.
        """
        target, texture = self._target_of(placement.size)
        panel = self._prepared(image, white_dn, placement, tone, compared, None)
        target.use()
        self._render(panel, placement.scissor)
        return texture.glo

    def draw_onto(
        self,
        part: WindowPart,
        image: moderngl.Texture | NDArray[np.uint8],
        white_dn: int,
        placement: Placement,
        tone: Tone,
        compared: ComparisonInput | None = None,
    ) -> None:
        """Draw the picture of `draw` onto a part, of the size of `placement`, of a window that has been cleared."""
        panel = self._prepared(image, white_dn, placement, tone, compared, part)
        part.framebuffer.use()
        self._context.viewport = 0, 0, *part.size
        self._render(panel, part.scissor(placement.scissor))

    def texture(self, size: tuple[int, int]) -> int:
        """Return the OpenGL name of the texture that `draw` draws into."""
        return self._target_of(size)[1].glo

    def _prepared(
        self,
        image: moderngl.Texture | NDArray[np.uint8],
        white_dn: int,
        placement: Placement,
        tone: Tone,
        compared: ComparisonInput | None,
        part: WindowPart | None,
    ) -> moderngl.VertexArray:
        """Set uniforms and textures, and return what is to be drawn."""
        if isinstance(image, np.ndarray):
            return self._prepared_processed(image, placement, part, night=tone.night)
        coarseness = placement.image_px_per_screen_px
        shrinks = sum(coarseness > step for step in _SHRINK_STEPS)
        program, panel = self._program_for(
            shrinks=shrinks, compares=compared is not None, coloured=tone.colours is not None
        )
        set_uniforms(
            program,
            simulated=0,
            screen_from_fragment_px=_UPRIGHT if part is None else part.screen_from_fragment_px,
            backdrop=_CLEAR if part is None else (*part.colour, 1.0),
            corner_px=placement.corner_px,
            image_px_per_screen_px=coarseness,
            simulated_white_dn=float(white_dn),
            black=tone.black,
            boost=tone.boost,
            softening=tone.softening,
            per_asinh=1 / asinh(tone.softening) if tone.softening else 0.0,
            night=int(tone.night),
        )
        if compared is not None:
            self._set_comparison(program, compared)
        if tone.colours is not None:
            set_uniforms(program, colour_map=2)
            self._colour_map_of(tone.colours).use(location=2)
        image.repeat_x = image.repeat_y = False  # as the shader expects
        image.use(location=0)
        return panel

    def _prepared_processed(
        self, image: NDArray[np.uint8], placement: Placement, part: WindowPart | None, *, night: bool
    ) -> moderngl.VertexArray:
        """Set uniforms and texture of a processed image, and return what is to be drawn."""
        if self._processed_program is None:
            program = linked(self._context, "whole_image.vert", "processed.frag")
            self._processed_program = program, self._context.vertex_array(program, [])
        program, panel = self._processed_program
        set_uniforms(
            program,
            processed=0,
            screen_from_fragment_px=_UPRIGHT if part is None else part.screen_from_fragment_px,
            backdrop=_CLEAR if part is None else (*part.colour, 1.0),
            corner_px=placement.corner_px,
            image_px_per_screen_px=placement.image_px_per_screen_px,
            night=int(night),
        )
        self._processed.of(image).use(location=0)
        return panel

    def _render(self, panel: moderngl.VertexArray, scissor: tuple[int, int, int, int]) -> None:
        self._context.enable_only(moderngl.NOTHING)
        self._context.scissor = scissor
        panel.render(moderngl.TRIANGLES, vertices=3)
        self._context.scissor = None
        self._screen.use()

    def read(self) -> NDArray[np.uint8]:
        """Read the target back, (height, width, 3) uint8, top row first: for tests."""
        assert self._target is not None
        width, height = self._target.size
        return np.frombuffer(self._target.read(components=3), np.uint8).reshape(height, width, 3)

    def _set_comparison(self, program: moderngl.Program, compared: ComparisonInput) -> None:
        """Set the uniforms and the texture of the real image."""
        set_uniforms(
            program,
            real=1,
            comparison=compared.mode,
            wipe=compared.wipe,
            covered_px=compared.covered_px,
            real_white_dn=float(compared.white_dn),
            real_black=compared.black,
            real_gain=compared.gain,
            more_rgb=compared.more_rgb,
            less_rgb=compared.less_rgb,
        )
        self._real.of(compared.pixels).use(location=1)

    def _program_for(
        self, *, shrinks: int, compares: bool, coloured: bool
    ) -> tuple[moderngl.Program, moderngl.VertexArray]:
        key = shrinks, compares, coloured
        if key not in self._programs:
            program = linked(
                self._context,
                "whole_image.vert",
                "display.frag",
                SHRINKS=shrinks,
                COMPARES=int(compares),
                COLOURED=int(coloured),
            )
            self._programs[key] = program, self._context.vertex_array(program, [])
        return self._programs[key]

    def _target_of(self, size: tuple[int, int]) -> tuple[moderngl.Framebuffer, moderngl.Texture]:
        if self._target is None or self._texture is None or self._texture.size != size:
            self._release_target()
            self._texture = self._context.texture(size, 4)
            self._texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._target = self._context.framebuffer([self._texture])
        return self._target, self._texture

    def _colour_map_of(self, colours: NDArray[np.uint8]) -> moderngl.Texture:
        if self._colour_map is None:
            self._colour_map = self._context.texture((len(colours), 1), 3, alignment=1)
            self._colour_map.filter = moderngl.NEAREST, moderngl.NEAREST
        self._colour_map.write(colours.tobytes(), alignment=1)
        return self._colour_map

    def _release_target(self) -> None:
        if self._target is not None and self._texture is not None:
            self._target.release()
            self._texture.release()
        self._target = None
        self._texture = None

    def close(self) -> None:
        """Release all OpenGL objects; a second call does nothing."""
        self._release_target()
        self._real.release()
        self._processed.release()
        if self._colour_map is not None:
            self._colour_map.release()
            self._colour_map = None
        programs = list(self._programs.values())
        if self._processed_program is not None:
            programs.append(self._processed_program)
        for program, panel in programs:
            panel.release()
            program.release()
        self._programs.clear()
        self._processed_program = None
