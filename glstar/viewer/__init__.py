"""The flight-replay viewer: a window in which a flight plays, and the camera's exposures appear as they are recorded.

`session` holds the state, `ui.interface` draws it on any OpenGL context, `window` and `headless` are the surfaces that
it is drawn on, `loop` runs it.  Play head, view, keys, overlays and comparison are plain modules without OpenGL.
"""
