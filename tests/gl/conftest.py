"""A context for each test of the GPU, or one for the renderers of a module; clean before and after each test."""

from collections.abc import Iterator
from contextlib import contextmanager

import moderngl
import pytest

from glstar.render.opengl import GLRenderer
from glstar.render.opengl.context import headless_context


@contextmanager
def _without_errors(context: moderngl.Context) -> Iterator[moderngl.Context]:
    with context:
        assert context.error == "GL_NO_ERROR"
        yield context
        assert context.error == "GL_NO_ERROR"


@pytest.fixture
def context() -> Iterator[moderngl.Context]:
    context = headless_context()
    with _without_errors(context):
        yield context
    context.release()


@pytest.fixture(scope="module")
def context_of_renderers() -> Iterator[moderngl.Context]:
    context = headless_context()
    yield context
    context.release()


@pytest.fixture
def renderer(context_of_renderers: moderngl.Context) -> Iterator[GLRenderer]:
    with _without_errors(context_of_renderers) as context, GLRenderer(context) as renderer:
        yield renderer
