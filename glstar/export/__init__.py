"""Frames of a flight written to disk, with the truth beside them.

A directory of an export holds ``frame_000000.png`` and so on, ``truth.jsonl`` (one line a frame) and
``manifest.json`` (settings and versions).  Each file is written under a temporary name and renamed when it is complete.
While an export runs its truth grows in ``truth.jsonl.partial``.  An export that was killed is continued by the same
command, and the directory is then byte for byte the same as after one run.

`prepare_export` reads a flight and plans its frames, and `Export.run` draws the missing ones.  The rooms, from the
bottom to the top:

===========================  ===========================================================================================
`directory`                  names of files and folders, no links, the lock and the lease, errors of the disk
`truth`                      `truth.lines` writes and reads ``truth.jsonl``; tables, splits and data card of it
`imagefiles`                 formats, camera processing, EXIF, FITS headers, masks
`plan`                       which frames there are, and the scene of each; ``manifest.json``
`frame`                      `FrameTask` draws and encodes a frame's files; `FrameWriter` writes them, then its truth
`run`                        prepares an export, draws its missing frames in processes or on a cluster; verifies
`convert`                    a complete export in the formats of other tools
`publish`                    frames for other programs while they are drawn
`navigator`, `environment`   what a navigator is handed of each frame, on disk and step by step
`live`                       export from a live MAVLink link
===========================  ===========================================================================================
"""
