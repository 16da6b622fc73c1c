"""The window of glstar: a flight plays, and the camera's exposures appear as they are recorded.

`session` holds the state, `ui` draws it on any OpenGL context, `loop` runs it on a surface: the `window`, or an
offscreen framebuffer.  `flight`, `overlays`, `picture` and `skyobjects` are plain modules without window and imgui.
"""
