"""The Sun, the Moon and the planets as lights of a scene."""

from functools import lru_cache

from glstar.render.scene import Scene
from glstar.sky.bodies import Body, observed_bodies

__all__ = ["bodies_of"]


# The sky and the flare of a scene ask several times for each texture and for truth.
@lru_cache(maxsize=8)
def bodies_of(scene: Scene, names: tuple[str, ...]) -> tuple[Body, ...]:
    """Return some bodies in the middle of the exposure of a scene.

    Parameters
    ----------
    scene : Scene
    names : tuple of str
        Of `glstar.sky.bodies.BODIES`.

    Returns
    -------
    tuple of Body
        In the order of `names`; empty in a scene that does not know its sky.
    """
    if scene.observing_sky is None:
        return ()
    # Those that are drawn are known; those of a stack are at the middle of one of its short exposures.
    if scene.bodies is not None and not scene.shorts:
        drawn = {body.name: body for body in scene.bodies.bodies}
        if drawn.keys() >= set(names):
            return tuple(drawn[name] for name in names)
    return observed_bodies(scene.observing_sky, scene.exposure.mid_utc_s, scene.site, names)
