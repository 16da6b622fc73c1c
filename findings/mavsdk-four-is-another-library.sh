#!/bin/sh
# mavsdk 4.1.0 on PyPI is another library than mavsdk 3: flight scripts that pin nothing fail at their first lines.
#
# Expected: `pip install mavsdk` gives MAVSDK-Python, as in its examples since 2019: System(), then await connect(...),
#   with a gRPC server beside it, and one module for each plugin, such as mavsdk.camera.
# What happens: version 4 took the name for a binding of the C++ library by ctypes.  mavsdk.System still exists, but is
#   made of a library and a handle and has no connect(); mavsdk.camera is an ImportError.  Systems come from
#   Mavsdk.get_systems(), calls block, and the former package is called mavsdk-grpc.
# Why it matters: ground stations, payload scripts and continuous integration of drones name mavsdk without a version.
#   What they begin with is still there by name, so that only a run shows the change; the errors say how to go back.
# Source: https://mavsdk.mavlink.io/main/en/python/migration.html
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mavsdk==4.1.0
"$folder/venv/bin/python" - <<'PYTHON'
import importlib
from importlib.metadata import version

import mavsdk

print("mavsdk", version("mavsdk"))
try:
    mavsdk.System()
except TypeError as error:
    print("System() raises TypeError:", error)
else:
    raise SystemExit("changed: System() can be made without arguments")
print("System has connect():", hasattr(mavsdk.System, "connect"))
try:
    importlib.import_module("mavsdk.camera")
except ImportError as error:
    print("mavsdk.camera:", str(error).splitlines()[0])
else:
    raise SystemExit("changed: mavsdk.camera can be imported")
if hasattr(mavsdk.System, "connect") or not hasattr(mavsdk.Mavsdk, "get_systems"):
    raise SystemExit("changed: System connects itself, or Mavsdk lists no systems")
PYTHON
