"""The flight-replay viewer: a window in which a flight plays, and the camera's exposures appear as they are recorded.

`session` holds what is shown, `interface` shows it on any OpenGL context, `window` and `headless` are what it is shown
on, `loop` runs it.  Time, view, keys, overlays and comparison are plain modules that know nothing of OpenGL.
"""
