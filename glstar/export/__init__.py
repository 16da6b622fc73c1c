"""Frames of a flight written to disk, with the truth beside them.

A directory of an export holds ``frame_000000.png`` and so on, ``truth.jsonl`` (one line a frame) and
``manifest.json`` (what made them).  Files appear whole: each is written under another name and renamed.  While an
export runs its truth grows in ``truth.jsonl.partial``; an export that was killed goes on where it stopped, and the
directory is then byte for byte what one run would have left.

`prepare` reads a flight and plans its frames, `Export.run` draws what is missing.
"""
