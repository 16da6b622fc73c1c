"""Frames of a flight written to disk, with the truth beside them.

A directory of an export holds ``frame_000000.png`` and so on, ``truth.jsonl`` (one line a frame) and
``manifest.json`` (settings and versions).  Each file is written under a temporary name and renamed when it is complete.
While an export runs its truth grows in ``truth.jsonl.partial``.  An export that was killed is continued by the same
command, and the directory is then byte for byte that of one run.

`prepare_export` reads a flight and plans its frames, and `Export.run` draws the missing ones.  The modules, from the
bottom to the top:

======================================  ================================================================================
`plan`, `frames`, `dataset`             which frames there are, and the scene of each
`task`                                  how to draw and write a frame: all that a process needs, and can be pickled
`framewriter`, `truthfile`, `images`    files and truth of a frame, in an order that survives a power failure
`executors`, `processes`, `cluster`     draw a task's frames in this process, in several processes, or on a Dask cluster
`run`                                   draws the missing frames of a directory, and returns a report
`prepare`                               reads flights and returns an `Export`
`verify`, `liveexport`                  compare a directory with what would be drawn; export from a live MAVLink link
======================================  ================================================================================
"""
