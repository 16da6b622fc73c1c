"""Test doubles of OpenGL, for tests of what is uploaded and released, and not of what is drawn."""

from typing import Any

import numpy as np


class Resource:
    """A texture, buffer, framebuffer or vertex array that remembers what was done to it."""

    def __init__(self, kind: str, *arguments: Any, **settings: Any) -> None:
        self.kind, self.arguments, self.settings = kind, arguments, settings
        self.releases = 0
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    @property
    def size(self) -> Any:
        return self.arguments[0] if self.kind == "texture" else self.settings.get("reserve")

    @property
    def components(self) -> int:
        return self.arguments[1]

    @property
    def dtype(self) -> str:
        return self.settings["dtype"]

    def release(self) -> None:
        self.releases += 1

    def write(self, data: Any, **settings: Any) -> None:
        self.calls.append(("write", (np.array(data),), settings))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **settings: self.calls.append((name, arguments, settings))

    def written(self) -> Any:
        """Return what was written last."""
        return [arguments[0] for name, arguments, _ in self.calls if name == "write"][-1]


class Program(dict):
    """A program with some uniforms."""

    def __init__(self, *uniforms: str) -> None:
        super().__init__(dict.fromkeys(uniforms))
        self.extra: dict[str, Any] = {}


class Context:
    """A context that makes resources, and remembers them."""

    def __init__(self, **info: Any) -> None:
        self.info = {"GL_MAX_TEXTURE_SIZE": 4096, "GL_POINT_SIZE_RANGE": (1.0, 255.0)} | info
        self.made: list[Resource] = []

    def _make(self, kind: str, *arguments: Any, **settings: Any) -> Resource:
        self.made.append(Resource(kind, *arguments, **settings))
        return self.made[-1]

    def texture(self, *arguments: Any, **settings: Any) -> Resource:
        return self._make("texture", *arguments, **settings)

    def buffer(self, *arguments: Any, **settings: Any) -> Resource:
        return self._make("buffer", *arguments, **settings)

    def framebuffer(self, *arguments: Any, **settings: Any) -> Resource:
        return self._make("framebuffer", *arguments, **settings)

    def vertex_array(self, *arguments: Any, **settings: Any) -> Resource:
        return self._make("vertex_array", *arguments, **settings)
