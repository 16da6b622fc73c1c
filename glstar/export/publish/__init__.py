"""Frames for other programs while they are drawn: shared memory, messages, a browser and a video device."""
