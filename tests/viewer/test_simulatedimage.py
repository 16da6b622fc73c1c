"""The simulated image without OpenGL: when it is composed, drawn, developed and read, against a renderer's double."""

from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.errors import ConfigError, RenderError
from glstar.export.frame import frame_seed
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.picture import simulated
from glstar.viewer.picture.simulated import ImageRequest, SimulatedImage


class Renderer:
    """Notes what it draws; `current`: the texture that it draws onto next."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.context, self.stacked = "context", None
        self.current = self.texture_of("first")

    @staticmethod
    def texture_of(name: str) -> SimpleNamespace:
        pixels = np.arange(6, dtype=np.uint8) + len(name)
        return SimpleNamespace(name=name, size=(3, 2), dtype=np.uint8, read=lambda alignment: pixels.tobytes())

    def expose(self, scene: Any) -> None:
        self.done.append(("expose", scene.name))

    def develop(self, scene: Any, *, seed: int, noiseless: bool) -> None:
        self.done.append(("develop", scene.name, seed, noiseless))

    def texture(self) -> Any:
        return self.current

    def holds(self, texture: Any) -> bool:
        return texture is None or texture is not self.current


class Sensor:
    def __init__(self, name: str) -> None:
        self.name = name

    def leaves_same_signal(self, other: "Sensor", _: object) -> bool:
        return self.name[0] == other.name[0]


SENSOR = Sensor("a1")


class Scene(SimpleNamespace):
    def with_sensor(self, sensor: Sensor) -> "Scene":
        return Scene(**vars(self) | {"name": f"{self.name} with {sensor.name}", "sensor": sensor})


class Simulator(SimpleNamespace):
    """Composes scenes; `broken`: raises an error instead."""

    def scene(self, exposure: Any) -> Scene:
        if self.broken:
            raise RenderError("too many stars")
        self.composed.append(exposure.start_utc_s)
        camera = SimpleNamespace(width_px=3, height_px=2)
        return Scene(name=f"at {exposure.start_utc_s:g}", sensor=self.sensor, shorts=(), camera=camera)


def simulator(**changes: Any) -> Simulator:
    gaps: dict[float, str] = {}
    attitude = SimpleNamespace(gap_within=lambda start_s, stop_s: gaps.get(start_s) or gaps.get(stop_s))
    values = {
        "flight": SimpleNamespace(attitude=attitude, gaps=gaps),
        "sky": "sky",
        "stars": "stars",
        "camera": "camera",
    }
    values |= {"mount": "mount", "pressure_hpa": 1010.0, "temperature_c": 10.0, "sensor": SENSOR, "broken": False}
    return Simulator(**values | {"composed": []} | changes)


def request(start_s: float, own: Simulator, number: int | None = None, *, noiseless: bool = False) -> ImageRequest:
    return ImageRequest(SimpleNamespace(start_utc_s=start_s, stop_utc_s=start_s + 0.5), number, own, noiseless)


@pytest.fixture
def image(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(simulated, "start_drawing", lambda: None)
    made = SimulatedImage(Renderer(), FrameTimes())
    monkeypatch.setattr(simulated, "wait_until_drawn", lambda _: made.renderer.done.append("waited"))
    yield made
    made.close()


def test_an_image_is_drawn_when_it_is_asked_for_and_once(image: Any) -> None:
    own = simulator()
    first = request(5.0, own, 3)
    assert not image.is_noiseless
    assert not ImageRequest("exposure", None, own).noiseless
    assert (image.size, image.has_image, image.texture, image.pixels, image.simulator) == (
        (0, 0),
        False,
        None,
        None,
        None,
    )
    assert image.update(first, playing=False)
    # The first image of a sensor is developed at once, with the seed of its number.
    assert image.renderer.done == [("develop", "at 5", frame_seed(0, 3), False)]
    assert (image.scene.name, image.number, image.size, image.simulator) == ("at 5", 3, (3, 2), own)
    assert image.has_image
    assert not image.update(first, playing=False)
    assert image.pixels.tolist() == [[5, 6, 7], [8, 9, 10]]
    assert image.pixels is image.pixels
    assert (image.renderer.done[1:], image.texture) == (["waited"], image.renderer.current)
    # The next image of the same sensor is only exposed; it is developed when it is read.
    image.renderer.done.clear()
    image.renderer.current = Renderer.texture_of("second!")
    again = request(7.0, own, noiseless=True)
    assert image.update(again, playing=False)
    assert image.renderer.done == [("expose", "at 7")]
    assert (image.number, image.is_noiseless) == (None, True)
    assert image.pixels[0, 0] == 7
    assert image.renderer.done[1:] == ["waited", ("develop", "at 7", frame_seed(0, 0), True), "waited"]
    # A stack cannot be developed later.
    image.renderer.done.clear()
    image._shown = image._shown._replace(scene=Scene(**vars(image.scene) | {"shorts": ()}))
    own.scene = lambda _: Scene(name="stack", sensor=SENSOR, shorts=(1, 2), camera=image.scene.camera)
    image.renderer.stacked = SimpleNamespace(saturated=np.eye(2, dtype=bool))
    image.update(request(9.0, own), playing=False)
    assert image.renderer.done == [("develop", "stack", frame_seed(0, 0), False)]
    assert image.tested.dtype == np.bool_
    image.renderer.stacked = None
    image.update(request(11.0, own), playing=False)
    assert image.tested is image.pixels
    kept, image._texture = image._texture, None
    assert image.pixels is None
    image._texture = kept
    image.clear()
    assert (image.scene, image.texture, image.has_image, image.tested) == (None, None, False, None)


def test_an_image_that_is_being_drawn_is_shown_when_its_request_comes_again(image: Any) -> None:
    own = simulator()
    image.update(request(5.0, own), playing=True)
    image._ahead[1].result()
    image.begin_next()
    # The first image of the renderer's texture is shown as soon as it is there.
    assert image._ahead is None
    following = request(6.0, own)
    image.update(following, playing=True)
    image._ahead[1].result()
    image.begin_next()
    started = image._developing
    assert image.update(following, playing=False) == (started is not None)
    assert image.scene.name == "at 6"
    # Another request drops the one that is being drawn.
    image.update(request(7.0, own), playing=True)
    image._ahead[1].result()
    image.begin_next()
    assert image.update(request(8.0, own), playing=False)
    assert (image.scene.name, image._developing) == ("at 8", None)
    assert not image.update(image._drawn, playing=False)
    # Asked for again before it is finished: nothing is composed.
    composed = list(own.composed)
    again = request(9.0, own)
    image._developing, image._drawn = simulated._Drawing(again, image.scene, is_developed=True), again
    assert image.update(again, playing=False)
    assert (image._developing, own.composed) == (None, composed)


def test_playing_shows_each_image_a_frame_later(image: Any) -> None:
    own = simulator()
    for start_s, shown in ((5.0, None), (6.0, "at 5"), (7.0, "at 6"), (8.0, "at 7")):
        assert not image.update(request(start_s, own), playing=True)
        assert (None if image.scene is None else image.scene.name) == shown
        image._ahead[1].result()
        image.begin_next()
        _ = image.texture
    assert own.composed == [5.0, 6.0, 7.0, 8.0]
    # What is drawn is not composed again, and nothing is begun without a composed scene.
    image._ahead = None
    drawn = image._drawn
    image.update(drawn, playing=True)
    assert image._ahead is None
    image.begin_next()
    assert own.composed == [5.0, 6.0, 7.0, 8.0]


def test_a_scene_that_takes_longer_is_waited_for_only_without_an_image(
    image: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, goes_on = simulator(), Event()
    compose = own.scene
    image.update(request(5.0, own), playing=False)
    own.scene = lambda exposure: goes_on.wait(10) and compose(exposure)
    monkeypatch.setattr(simulated, "_COMPOSING_S", 0.001)
    image.update(request(6.0, own), playing=True)
    image.begin_next()
    assert image._ahead is not None
    # Meanwhile no other scene is begun.
    waiting = image._ahead
    image.update(request(7.0, own), playing=True)
    assert image._ahead is waiting
    goes_on.set()
    image._ahead[1].result()
    image.begin_next()
    assert image._ahead is None
    image.update(request(7.0, own), playing=False)
    assert image.scene.name == "at 7"


def test_an_error_or_a_gap_is_said_and_the_last_image_stays(image: Any) -> None:
    own = simulator()
    image.update(request(5.0, own), playing=False)
    own.broken = True
    image.update(request(6.0, own), playing=False)
    assert (image.error, image.scene.name, image.pixels) == ("too many stars", "at 5", None)
    own.broken = False
    own.flight.gaps[7.5] = "gap"
    image._ahead = "ahead"
    assert not image.update(request(7.0, own), playing=True)
    assert (image.gap, image.error, image._ahead, image._drawn, image.pixels) == ("gap", "", None, None, None)
    assert image.update(request(5.0, own), playing=False)
    assert image.gap is None
    assert image.pixels is not None


def test_a_scene_is_composed_again_only_if_more_than_its_noise_changes(image: Any) -> None:
    own = simulator()
    image.update(request(5.0, own), playing=False)
    exposure = image._shown.request.exposure
    noisier = simulator(flight=own.flight, sensor=Sensor("a2"), composed=own.composed)
    image.update(ImageRequest(exposure, None, noisier), playing=False)
    assert (image.scene.name, own.composed) == ("at 5 with a2", [5.0])
    # A sky equals another one with the same catalogue and models.
    same = {"catalogue": "bsc5", "astrometry": "erfa", "dut1_s": 0.0, "refraction": True}
    equal = [SimpleNamespace(**same, name=name) for name in "ab"]
    assert simulated._are_equal(*equal)
    for key, value in (("catalogue", "x"), ("astrometry", "paper"), ("dut1_s", 0.1), ("refraction", False)):
        assert not simulated._are_equal(equal[0], SimpleNamespace(**same | {key: value}))
    assert simulated._are_equal(1010.5, float("1010.5"))
    assert not simulated._are_equal(equal[0], "sky")
    assert not simulated._are_equal("sky", equal[0])
    others = [{"sensor": Sensor("b1")}, {"camera": "another"}, {"mount": "another"}, {"pressure_hpa": 990.0}]
    for changes in (*others, {"temperature_c": 3.0}, {"stars": "others"}, {"sky": "another"}):
        own.composed.clear()
        image._shown = image._shown._replace(request=ImageRequest(exposure, None, own), scene=image.scene)
        changed = simulator(flight=own.flight, composed=own.composed, **changes)
        image.update(ImageRequest(exposure, None, changed), playing=False)
        assert own.composed == [5.0], changes
    later = SimpleNamespace(start_utc_s=6.0, stop_utc_s=6.5)
    image.update(ImageRequest(later, None, own), playing=False)
    assert own.composed == [5.0, 6.0]


@pytest.mark.parametrize(
    ("active", "factor", "reason"),
    [
        (False, 1, 'the camera writes the raw image; settings with [output] process = "isp" develop it'),
        (True, 2, 'sums of raw images are not processed; exposure.stack = "mean" is'),
        (True, 1, ""),
    ],
)
def test_it_is_said_why_an_image_has_no_processed_form(
    image: Any, monkeypatch: pytest.MonkeyPatch, active: bool, factor: int, reason: str
) -> None:
    monkeypatch.setattr(simulated.CameraProcessing, "of", lambda _: SimpleNamespace(is_active=active))
    scene = SimpleNamespace(sensor="sensor", exposure=SimpleNamespace(signal_factor=factor))
    assert simulated.why_not_processed(scene) == reason
    assert image.processed is None
    own, made = simulator(), []
    image.update(request(5.0, own), playing=False)
    image.scene.exposure = scene.exposure
    monkeypatch.setattr(
        simulated, "process", lambda pixels, sensor, sixteen_bits: made.append(sixteen_bits) or pixels + 1
    )
    if reason:
        assert image.processed is None
    else:
        colours = image.processed
        assert colours is image.processed
        assert (colours.shape, made, colours[1, 2].tolist()) == ((2, 3, 3), [False], [11, 11, 11])
        image._processed = None
        monkeypatch.setattr(simulated, "process", lambda *_, **__: np.full((2, 3, 3), 7, np.uint8))
        assert (image.processed == 7).all()

    def refuse(_: object) -> None:
        raise ConfigError("output.black_dn is too large")

    monkeypatch.setattr(simulated.CameraProcessing, "of", refuse)
    assert simulated.why_not_processed(scene) == "output.black_dn is too large"
