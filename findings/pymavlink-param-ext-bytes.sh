#!/bin/sh
# pymavlink 2.4.50 hands over a PARAM_EXT value without its bytes: 0.5 is an empty text, 0.1 replacement characters.
#
# Expected: the field param_value of PARAM_EXT_VALUE, PARAM_EXT_SET and PARAM_EXT_ACK holds 128 bytes, in which the number
#   lies as in memory (QGroundControl and MAVSDK write and read it so).  A float of 0.5 is 00 00 00 3f.
# What happens: the XML types the field char[128], so pymavlink ends it at the first zero and decodes it as ASCII with
#   replacement characters.  Of 0.5, 1, 2 and every power of two nothing is left; other values come changed;
#   what was sent cannot be found again from param_value.  There is no error.  The bytes are in an attribute of
#   an underscore, _param_value_raw, without the zeros that MAVLink 2 cuts at the end of a packet.
# Why it matters: settings of cameras (exposure, gain, mode) are PARAM_EXT.  A companion or a test in Python that reads
#   param_value sets another exposure than the ground station sent, or none.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pymavlink==2.4.50
"$folder/venv/bin/python" - <<'PYTHON'
import struct
import sys
from importlib.metadata import version

from pymavlink.dialects.v20 import common

read, raw = [], []
for value in (0.5, 2.0, 0.1):
    sent = struct.pack("<f", value)
    message = common.MAVLink_param_ext_value_message(b"CAM_SHUTTERSPD", sent.ljust(128, b"\0"), 9, 1, 0)
    got = common.MAVLink(None).decode(bytearray(message.pack(common.MAVLink(None, 1, 100))))
    read.append(got.param_value)
    raw.append(struct.unpack("<f", got._param_value_raw.ljust(4, b"\0")[:4])[0] == struct.unpack("<f", sent)[0])
    print(f"sent {value} as {sent.hex(' ')}: param_value {got.param_value!r}")
print(f"pymavlink {version('pymavlink')}; the bytes are in _param_value_raw: {raw}")
sys.exit(0 if read[:2] == ["", ""] and "\ufffd" in read[2] and all(raw) else "this has changed")
PYTHON
