"""The keys that sensor and sky effects add to the sections of the config."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, create_model

from glstar.config.section import Section
from glstar.render.effects import EFFECTS, Key

__all__ = ["with_effect_keys"]


S = TypeVar("S", bound=Section)


def with_effect_keys(name: str) -> Callable[[type[S]], type[S]]:
    """Add the keys of the effects in a section of the config to its model.

    Parameters
    ----------
    name : str
        The section.

    Returns
    -------
    callable
        A decorator of a subclass of `Section`.
    """

    def extended(model: type[S]) -> type[S]:
        keys = [key for effect in EFFECTS if effect.section == name for key in effect.keys]
        return create_model(
            model.__name__,
            __base__=model,
            __module__=model.__module__,
            __doc__=model.__doc__,
            **{key.name: _field(key) for key in keys},
        )

    return extended


def _field(key: Key) -> Any:
    """Return the type and the checks of an effect's key for `pydantic.create_model`."""
    if key.or_number:
        number = Annotated[float, Field(ge=key.minimum, le=key.maximum)]
        return Literal[key.choices] | number, Field(default=key.default, description=key.allowed)
    if key.or_points:
        return str | list[Any], Field(default=key.default, description=key.allowed)
    kind = Literal[key.choices] if key.choices else type(key.default)
    return kind, Field(default=key.default, ge=key.minimum, gt=key.above, le=key.maximum, description=key.allowed)
