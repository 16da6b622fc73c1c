"""A context for each test of the GPU, clean before and after."""

from collections.abc import Iterator

import moderngl
import pytest

from glstar.render.opengl import GLRenderer
from glstar.render.opengl.context import headless_context


@pytest.fixture
def context() -> Iterator[moderngl.Context]:
    context = headless_context()
    with context:
        assert context.error == "GL_NO_ERROR"
        yield context
        assert context.error == "GL_NO_ERROR"
    context.release()


@pytest.fixture
def renderer(context: moderngl.Context) -> Iterator[GLRenderer]:
    with GLRenderer(context) as renderer:
        yield renderer
