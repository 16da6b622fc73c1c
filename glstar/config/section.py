"""The base class of the sections of the config, and the keys that sensor and sky effects add to sections."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model

from glstar.render.effects import EFFECTS, Key


class Section(BaseModel):
    """A section of the config: no unknown keys, no conversions except from integer to float, no inf and no nan."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


S = TypeVar("S", bound=Section)


def with_effect_keys(name: str) -> Callable[[type[S]], type[S]]:
    """Return a decorator that adds the keys of the effects in a section to its subclass of `Section`."""

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


def is_file_name(name: str) -> bool:
    """Return whether a name is a path rather than one of the names that glstar knows."""
    return bool(Path(name).suffix) or len(Path(name).parts) > 1
