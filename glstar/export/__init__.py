"""Frames of a flight written to disk, with the truth beside them.

A directory of an export holds ``frame_000000.png`` and so on, ``truth.jsonl`` (one line a frame) and
``manifest.json`` (what made them).  Files appear whole: each is written under another name and renamed.  While an
export runs its truth grows in ``truth.jsonl.partial``; an export that was killed goes on where it stopped, and the
directory is then byte for byte what one run would have left.

`prepare` reads a flight and plans its frames, `Export.run` draws what is missing.
"""

from glstar.durable import write_whole
from glstar.export.crew import Alone, Crew, processors
from glstar.export.files import words_for_the_disk
from glstar.export.frames import FlightFrames
from glstar.export.images import ImageFormat, encode, write_video
from glstar.export.job import DrawnFrame, Export, ExportReport, frame_seed, prepare, prepare_data_set
from glstar.export.live import LiveExport, LiveReport
from glstar.export.plan import Plan, PlannedFrame, SkippedFrame
from glstar.export.shard import Shard
from glstar.export.workers import Workers

__all__ = [
    "Alone",
    "Crew",
    "DrawnFrame",
    "Export",
    "ExportReport",
    "FlightFrames",
    "ImageFormat",
    "LiveExport",
    "LiveReport",
    "Plan",
    "PlannedFrame",
    "Shard",
    "SkippedFrame",
    "Workers",
    "encode",
    "frame_seed",
    "prepare",
    "prepare_data_set",
    "processors",
    "words_for_the_disk",
    "write_video",
    "write_whole",
]
