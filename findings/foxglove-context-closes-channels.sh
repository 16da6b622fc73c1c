#!/bin/sh
# foxglove-sdk 0.30.3 (Python): a recording stays empty if nothing keeps the Context, although channels and writer are held.
#
# Expected: an object keeps what it needs.  A channel that was made with context=..., and an open MCAP writer of the same
#   context, go on working while they are referenced, as files, loggers and sockets of Python do.
# What happens: neither holds the Context.  When its last reference goes, at the end of the function that made it, its
#   channels close.  Every log() afterwards returns as usual; the one sign is a record of Python's logging at level
#   WARNING, "Cannot log on closed channel", which a program that has set its handlers to errors never shows.
# Why it matters: a helper that makes context, channels and writer, and returns the last two, writes a valid MCAP file
#   without a message, or serves a live view that stays black.  In a flight, that recording cannot be made again.
# Source: https://docs.foxglove.dev/docs/sdk (contexts): "the binding between channels and sinks"; no word on its lifetime.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet foxglove-sdk==0.30.3 mcap==1.6.0
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import gc
import sys
from importlib.metadata import version

import foxglove
from foxglove.channels import CompressedImageChannel
from foxglove.messages import CompressedImage
from mcap.reader import make_reader


def recorded(path, keeps):
    """Write ten messages, with the context kept or not, and return how many are in the file."""
    context = foxglove.Context()
    channel = CompressedImageChannel("/image", context=context)
    writer = foxglove.open_mcap(path, context=context)
    kept = [context] if keeps else []
    del context
    gc.collect()
    for number in range(10):
        channel.log(CompressedImage(data=b"one", format="png"), log_time=number)
    writer.close()
    del kept
    with open(path, "rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())


with_context, without = (recorded(f"{sys.argv[1]}/{keeps}.mcap", keeps) for keeps in (True, False))
print(f"foxglove-sdk {version('foxglove-sdk')}")
print(f"messages logged: 10; in the file with the context kept: {with_context}; not kept: {without}")
sys.exit(0 if (with_context, without) == (10, 0) else "this has changed")
PYTHON
