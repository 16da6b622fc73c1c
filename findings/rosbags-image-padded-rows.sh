#!/bin/sh
# rosbags-image 0.10.4 shears an image whose rows are padded: it does not read the field `step`.
#
# Expected: sensor_msgs/Image says that `step` is the length of a row in bytes; drivers pad rows to a multiple of 4, 8 or 64,
#   and cv_bridge of ROS skips the padding.
# What happens: message_to_cvimage takes the first width * height pixels of the data in one piece.  The padding becomes part
#   of the image, every row begins later than the one above, and the last rows are lost.  No error, no warning.
# Why it matters: stars of a camera whose width is no multiple of its driver's alignment are sheared out of their places.
# Source: https://docs.ros.org/en/api/sensor_msgs/html/msg/Image.html ("step: full row length in bytes").
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9 'rosbags-image[opencv-headless]==0.10.4'
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version

import numpy as np
from rosbags.image import message_to_cvimage
from rosbags.typesys import Stores, get_typestore

types = get_typestore(Stores.ROS2_HUMBLE).types
header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
pixels = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], dtype=np.uint8)
padded = np.zeros((3, 8), dtype=np.uint8)
padded[:, :3] = pixels
image = types["sensor_msgs/msg/Image"](
    header=header, height=3, width=3, encoding="mono8", is_bigendian=0, step=8, data=padded.ravel()
)
read = message_to_cvimage(image)
print(f"rosbags-image {version('rosbags-image')}, rows of 3 pixels in 8 bytes")
print("written", pixels.tolist())
print("read   ", read.tolist())
sys.exit(0 if read.tolist() == [[1, 2, 3], [0, 0, 0], [0, 0, 4]] else "this has changed")
PYTHON
