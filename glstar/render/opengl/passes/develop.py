"""The develop pass: from the noiseless signal to digital numbers, with the GLSL of the active effects.

Where charge moves along columns or rows, these are read from the GPU, changed on the CPU and uploaded again.
"""

import re
from collections.abc import Hashable, Mapping, Sequence
from contextlib import ExitStack
from itertools import count
from types import MappingProxyType
from typing import NamedTuple, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.effects import EFFECTS, active_effects
from glstar.render.effects.effect import ChargeTransfer, Effect, EffectTexture, Stage, UniformValue, Values
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.targets import Targets
from glstar.render.scene.scene import Scene

# A declaration of numbers that an effect's GLSL reads.
_NUMBERS = re.compile(r"uniform ((?:[iu]?vec([234]))|float|u?int) (\w+(?:, ?\w+)*);(.*)")
# Every driver passes 60 components from vertex to fragment; develop.vert has ten of its own.
_MOST_COMPONENTS = 48


class EffectSources(NamedTuple):
    """Sources that the shaders of the develop pass include."""

    by_name: Mapping[str, str]  # GLSL by the name in ``#include``
    numbers: Mapping[str, str]  # Names that effects give to numbers, by the names of the uniforms of the vertex shader


def composed_sources(effects: Sequence[Effect]) -> EffectSources:
    """Return the GLSL that applies effects in turn.

    The numbers that an effect declares as ``uniform`` become inputs of the fragment shader, which the vertex shader
    sets from uniforms: on software OpenGL that takes a third of the time.  The values are the same.
    """
    sources: dict[str, str] = {}
    types: dict[str, str] = {}
    for effect in effects:
        lines = [_with_inputs(line, types) for line in effect.glsl.splitlines()]
        sources[f"effect {effect.name}"] = "\n".join(lines) + "\n"
    called = [f'#include "{name}"' for name in sources]
    called += ["vec4 with_effects(vec4 signal_dn, uvec2 quad) {"]
    called += [f"    signal_dn = {effect.name}(signal_dn, quad);" for effect in effects]
    called += ["    return signal_dn;", "}"]
    numbers = [f"uniform {kind} given_{name};\nflat out {kind} {name};" for name, kind in types.items()]
    numbers += ["void set_numbers_of_effects() {", *(f"    {name} = given_{name};" for name in types), "}"]
    return EffectSources(
        sources | {"effects.glsl": "\n".join(called) + "\n", "numbers of effects": "\n".join(numbers) + "\n"},
        {f"given_{name}": name for name in types},
    )


def _with_inputs(line: str, types: dict[str, str]) -> str:
    """Return a line of GLSL in which numbers are inputs, and add their types by name; other lines stay."""
    declaration = _NUMBERS.fullmatch(line)
    if declaration is None:
        return line
    kind, components, names, comment = declaration.groups()
    by_name = dict.fromkeys(re.split(", ?", names), kind)
    added = len(by_name) * int(components or 1)
    if added + sum(int(earlier[-1]) if earlier[-1].isdigit() else 1 for earlier in types.values()) > _MOST_COMPONENTS:
        return line
    types.update(by_name)
    return f"flat in {kind} {names};{comment}"


# Lines changed at once, which bounds the memory: 256 columns of 3040 px in float64 are 6 MB.
_LINES_AT_ONCE = 256

Rectangle = tuple[int, int, int, int]

_NO_TEXTURES: Mapping[str, moderngl.Texture] = MappingProxyType({})


class DevelopOutput(NamedTuple):
    """What the shaders of the develop pass draw."""

    output: int  # ``OUTPUT`` and ``LINES`` of develop.frag
    lines: int
    points: int = 0  # ``POINTS`` of develop.vert


class DrawDeveloped(Protocol):
    """A function that draws images and signals."""

    def __call__(
        self,
        target: moderngl.Framebuffer,
        output: DevelopOutput,
        textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
        rectangles: Sequence[Rectangle] = (),
    ) -> None:
        """Draw what `output` says to a target: in rectangles (x, y, width, height) of it, or everywhere."""


class ChargeTransferPass:
    """Draws an image, finds the lines in which charge moves, and draws these again."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context

    def draw(
        self, transfer: ChargeTransfer, width_px: int, image: moderngl.Framebuffer, developed: DrawDeveloped
    ) -> None:
        """Draw an image in which charge moves.

        `image` is its target, whose texels have several pixels each; `developed` draws the image, or the signal before
        the charge moves.
        """
        by_columns = transfer.along == "columns"
        lines = 1 if by_columns else 2
        largest_dn = self._image_and_largest(image, DevelopOutput(1, lines), developed)
        above = largest_dn.max(axis=0 if by_columns else 1) > transfer.threshold_dn
        if not above.any():
            return
        rectangles = _rectangles(above, image.size, by_columns=by_columns)
        quads = -(-width_px // 4)
        if by_columns:
            above = np.repeat(above, -(-quads // len(above)))[:quads]
        chosen = np.flatnonzero(above)
        size = (len(chosen), image.height) if by_columns else (quads, len(chosen))
        with ExitStack() as owned:
            moved, target = self._target(owned, size, 4, image)
            developed(target, DevelopOutput(2, lines), {"chosen_lines": self._numbers(owned, chosen)})
            signal_dn = np.empty((size[1], size[0], 4), np.float32)
            target.read_into(signal_dn, components=4, dtype="f4")
            _transfer_charge(transfer, signal_dn, width_px)
            moved.write(signal_dn)
            textures = {"moved_dn": moved, "number_of_line": self._numbers(owned, np.cumsum(above) - 1)}
            developed(image, DevelopOutput(0, lines), textures, rectangles)

    def _image_and_largest(
        self, image: moderngl.Framebuffer, output: DevelopOutput, developed: DrawDeveloped
    ) -> NDArray[np.float32]:
        """Draw the image as if no charge moved; return the largest signal of each of its texels, (rows, columns)."""
        largest_dn = np.empty(image.size[::-1], np.float32)
        with ExitStack() as owned:
            _, target = self._target(owned, image.size, 1, image, *image.color_attachments)
            developed(target, output)
            target.read_into(largest_dn, components=1, attachment=1, dtype="f4")
        return largest_dn

    def _target(
        self,
        owned: ExitStack,
        size: tuple[int, int],
        components: int,
        image: moderngl.Framebuffer,
        *before: moderngl.Texture | moderngl.Renderbuffer,
    ) -> tuple[moderngl.Texture, moderngl.Framebuffer]:
        """Return a float texture and a framebuffer that draws to it, after other textures."""
        texture = self._context.texture(size, components, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        owned.callback(texture.release)
        target = self._context.framebuffer([*before, texture])
        owned.callback(target.release)
        owned.callback(image.use)  # first: a bound target cannot be released
        return texture, target

    def _numbers(self, owned: ExitStack, numbers: NDArray[np.intp]) -> moderngl.Texture:
        """Return a texture of a number per line."""
        texture = self._context.texture((len(numbers), 1), 1, numbers.astype(np.float32), dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        owned.callback(texture.release)
        return texture


def _rectangles(above: NDArray[np.bool_], size: tuple[int, int], *, by_columns: bool) -> list[Rectangle]:
    """Return rectangles of an image's texels that have all chosen columns or rows of them: one for each run."""
    ends = np.flatnonzero(np.diff(above, prepend=False, append=False)).reshape(-1, 2).tolist()
    if by_columns:
        return [(first, 0, end - first, size[1]) for first, end in ends]
    return [(0, first, size[0], end - first) for first, end in ends]


def _transfer_charge(transfer: ChargeTransfer, signal_dn: NDArray[np.float32], width_px: int) -> None:
    """Move charge in place: along columns in groups of four, (rows, n, 4), or along rows, (n, columns / 4, 4)."""
    rows = signal_dn.reshape(len(signal_dn), -1)
    lines_dn = rows.T if transfer.along == "columns" else rows[:, :width_px]
    above = np.flatnonzero(lines_dn.max(axis=1) > transfer.threshold_dn)
    for first in range(0, len(above), _LINES_AT_ONCE):
        lines = above[first : first + _LINES_AT_ONCE]
        lines_dn[lines] = transfer.moved(lines_dn[lines].astype(np.float64))


# Largest number of a float of 16 bits.
_MOST_HALF = float(np.finfo(np.float16).max)

_DIGITAL_NUMBERS = DevelopOutput(output=0, lines=0)
_AT_POINTS = DevelopOutput(output=0, lines=0, points=1)
# Effects that change at most one pixel in `_FEW_IN` are drawn only around these, in images of at least `_LARGE_PX`.
# Of 2500 hot pixels in 12 megapixels that takes a third of the time of a texture of all pixels.
_FEW_IN = 2000
_LARGE_PX = 1_000_000


class DevelopPass:
    """Applies the effects to the noiseless signal: sky, noise, quantisation and others.

    The shader is composed of the GLSL of the active effects in the order of their stages; each combination of active
    effects and their options is compiled when it is first used.  The image is drawn as texels of 16 bytes, each of them
    16 pixels of 8 bits or 8 pixels of 16 bits side by side, because that takes half the time on software OpenGL.
    Raises ShaderError if the driver rejects the shader of the effects that are active by default.  Teague & Chahl, eq.
    (40).
    """

    def __init__(self, context: moderngl.Context, effects: Sequence[Effect] = EFFECTS) -> None:
        self._context = context
        self._effects = tuple(effects)
        self._programs: dict[Hashable, _Program] = {}
        self._textures: dict[tuple[str, str], _Texture] = {}
        self._charge_transfer_pass = ChargeTransferPass(context)
        for dtype in (np.uint8, np.uint16):
            self._program(dtype, _in_this_pass(Sensor(), self._effects), _DIGITAL_NUMBERS)

    def draw(self, scene: Scene, targets: Targets, *, seed: int, noiseless: bool = False) -> None:
        """Develop the image of some targets from their noiseless signal; `noiseless` leaves out the noise.

        Raises ShaderError if the driver rejects the shader of these effects, and RenderError if an effect declares a
        uniform and gives no value for it, or several effects move charge.
        """
        active = _in_this_pass(scene.sensor, self._effects, noiseless=noiseless)
        inputs = _Inputs(scene, targets, seed, _settings(active, scene))
        moving = [number for number, effect in enumerate(active) if effect.transfer is not None]
        if not moving:
            self._draw_in_parts(active, inputs)
        elif len(moving) == 1:
            self._draw_with_moved_charge(active, moving[0], inputs)
        else:
            raise RenderError(f"at most one effect moves charge, not {' and '.join(active[k].name for k in moving)}")

    def _draw_in_parts(self, active: tuple[Effect, ...], inputs: "_Inputs") -> None:
        """Draw an image; effects that change few pixels of a large one only around these."""
        image = inputs.targets.image
        changed = _changed_px(active, inputs.scene)
        self._draw(tuple(effect for effect in active if effect not in changed), inputs, image, _DIGITAL_NUMBERS)
        if changed:
            points = np.concatenate(list(changed.values())).astype(np.float32)
            points[:, 0] = points[:, 0] // inputs.targets.pixels_per_texel
            program = self._with_uniforms(active, inputs, image, _AT_POINTS)
            buffer = self._context.buffer(points)
            vertices = self._context.vertex_array(program.program, [(buffer, "2f", "point")])
            vertices.render(moderngl.POINTS)
            vertices.release()
            buffer.release()

    def _draw_with_moved_charge(self, active: tuple[Effect, ...], number: int, inputs: "_Inputs") -> None:
        """Draw an image in which the effect of some number moves charge."""
        effect, scene = active[number], inputs.scene
        assert effect.transfer is not None

        def developed(
            target: moderngl.Framebuffer,
            output: DevelopOutput,
            textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
            rectangles: Sequence[Rectangle] = (),
        ) -> None:
            effects = active[:number] if output.output == 2 else active
            self._draw(effects, inputs, target, output, textures, rectangles)

        transfer = effect.transfer(inputs.settings[effect].values, scene)
        self._charge_transfer_pass.draw(transfer, scene.camera.width_px, inputs.targets.image, developed)

    def _draw(
        self,
        active: tuple[Effect, ...],
        inputs: "_Inputs",
        target: moderngl.Framebuffer,
        output: DevelopOutput,
        textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
        rectangles: Sequence[Rectangle] = (),
    ) -> None:
        """Draw the image or a signal to a target: in rectangles of it, or everywhere."""
        program = self._with_uniforms(active, inputs, target, output, textures)
        whole = (0, 0, *target.size)
        for rectangle in rectangles or [whole]:
            target.scissor = rectangle
            program.whole_image.render(moderngl.TRIANGLES, vertices=3)
        target.scissor = whole

    def _with_uniforms(
        self,
        active: tuple[Effect, ...],
        inputs: "_Inputs",
        target: moderngl.Framebuffer,
        output: DevelopOutput,
        textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
    ) -> "_Program":
        """Return the program of some effects, after setting its uniforms, textures and target."""
        scene = inputs.scene
        options = {name: value for effect in active for name, value in inputs.settings[effect].options.items()}
        program = self._program(inputs.targets.dtype, active, output, options)
        uniforms: dict[str, UniformValue] = {
            "signal": 0,
            "signal_border_px": inputs.targets.guard_band_px,
            "signal_size_px": inputs.targets.light.size,
            "image_size_px": (scene.camera.width_px, scene.camera.height_px),
            "noise_seed": inputs.seed,
            "target_size": target.size,
        }
        inputs.targets.light_texture.use(location=0)
        units = count(1)
        for sampler, moved in textures.items():
            uniforms[sampler] = unit = next(units)
            moved.use(location=unit)
        for effect in active:
            values, of_effect, _ = inputs.settings[effect]
            uniforms |= of_effect
            for texture in (read for read in effect.textures if read.sampler in program.names):
                uniforms[texture.sampler] = unit = next(units)
                self._texture(effect, texture, values, scene).use(location=unit)
        if missing := set(program.names.values()) - uniforms.keys():
            raise RenderError(f"no effect gives a value to the uniform {min(missing)} of the develop shader")
        set_uniforms(program.program, **{name: uniforms[number] for name, number in program.names.items()})
        self._context.enable_only(moderngl.NOTHING)
        target.use()
        return program

    def _program(
        self,
        dtype: type[np.uint8] | type[np.uint16],
        active: tuple[Effect, ...],
        output: DevelopOutput,
        options: Mapping[str, int] = MappingProxyType({}),
    ) -> "_Program":
        key = dtype, active, output, tuple(options.items())
        if key not in self._programs:
            sources = composed_sources(active)
            program = linked(
                self._context,
                "develop.vert",
                "develop.frag",
                generated=sources.by_name,
                SIXTEEN_BITS=int(dtype is np.uint16),
                OUTPUT=output.output,
                LINES=output.lines,
                POINTS=output.points,
                **options,
            )
            names = {
                name: sources.numbers.get(name, name) for name in program if isinstance(program[name], moderngl.Uniform)
            }
            self._programs[key] = _Program(program, self._context.vertex_array(program, []), names)
        return self._programs[key]

    def _texture(self, effect: Effect, texture: EffectTexture, values: Values, scene: Scene) -> moderngl.Texture:
        key = effect.name, texture.sampler
        depends_on = texture.depends_on(values, scene)
        earlier = self._textures.get(key)
        if earlier is not None:
            if earlier.depends_on == depends_on:
                return earlier.texture
            del self._textures[key]
            earlier.texture.release()
        texels = np.atleast_3d(np.asarray(texture.texels(values, scene), dtype=np.float32))
        rows, columns, components = texels.shape
        kind, dtype = ("f2", np.float16) if texture.per_quad else ("f4", np.float32)
        content = np.ascontiguousarray(np.clip(texels, -_MOST_HALF, _MOST_HALF) if texture.per_quad else texels, dtype)
        uploaded = self._context.texture((columns, rows), components, content, dtype=kind)
        if texture.per_quad:
            uploaded.filter = moderngl.NEAREST, moderngl.NEAREST
        uploaded.repeat_x = uploaded.repeat_y = False
        self._textures[key] = _Texture(uploaded, depends_on)
        return uploaded

    def release(self) -> None:
        """Release programs and textures."""
        with ExitStack() as owned:
            for program in self._programs.values():
                owned.callback(program.program.release)
                owned.callback(program.whole_image.release)
            for texture in self._textures.values():
                owned.callback(texture.texture.release)
            self._programs = {}
            self._textures = {}


class _Inputs(NamedTuple):
    """The inputs of a developed image."""

    scene: Scene
    targets: Targets
    seed: int
    settings: Mapping[Effect, "_Settings"]


class _Settings(NamedTuple):
    """What an effect is drawn with: the values of its keys, its uniforms and its options."""

    values: Values
    uniforms: Mapping[str, UniformValue]
    options: Mapping[str, int]


class _Program(NamedTuple):
    program: moderngl.Program
    whole_image: moderngl.VertexArray
    names: Mapping[str, str]  # of uniforms: that of the program, and that of the effect


class _Texture(NamedTuple):
    texture: moderngl.Texture
    depends_on: Hashable


def _settings(effects: Sequence[Effect], scene: Scene) -> dict[Effect, _Settings]:
    of_effects = ((effect, effect.values(scene.sensor)) for effect in effects)
    return {
        effect: _Settings(values, effect.uniforms(values, scene), effect.options(values, scene))
        for effect, values in of_effects
    }


def _changed_px(effects: Sequence[Effect], scene: Scene) -> dict[Effect, NDArray[np.int64]]:
    """Return the effects that change few pixels of a large image, with the columns and rows of these, (n, 2)."""
    size_px = scene.camera.width_px * scene.camera.height_px
    changed = {}
    for effect in effects if size_px >= _LARGE_PX else ():
        if effect.only_at is not None:
            pixels = effect.only_at(effect.values(scene.sensor), scene)
            if pixels is not None and len(pixels) * _FEW_IN <= size_px:
                changed[effect] = pixels
    return changed


def _in_this_pass(sensor: Sensor, effects: Sequence[Effect], *, noiseless: bool = False) -> tuple[Effect, ...]:
    active = (effect for effect in active_effects(sensor, effects) if effect.glsl)
    return tuple(effect for effect in active if not (noiseless and effect.stage in {Stage.SHOT_NOISE, Stage.NOISE}))
