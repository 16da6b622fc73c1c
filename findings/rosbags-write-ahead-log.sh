#!/bin/sh
# rosbags 0.11.9 reads a .db3 without the write-ahead log beside it, and says nothing of the messages in it.
#
# Expected: a database of SQLite in WAL mode is the .db3 and its .db3-wal together; every reader of SQLite sees both.
#   rosbag2 records in this mode with its storage preset "resilient", and a recorder that loses power leaves the file.
# What happens: the reader opens the file as immutable, so that SQLite does not look for the log.  The bag opens, the
#   messages up to the last checkpoint come, and the newer ones are missing without an error or a warning.
# Why it matters: the preset is chosen so that a flight survives a crash; its last seconds are what one looks for.
# Source: https://github.com/ros2/rosbag2 (rosbag2_storage_sqlite3, presets), https://sqlite.org/uri.html (immutable).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet rosbags==0.11.9
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import shutil
import sqlite3
import sys
from importlib.metadata import version
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

folder = Path(sys.argv[1])
store = get_typestore(Stores.ROS2_HUMBLE)
String = store.types["std_msgs/msg/String"]
with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
    connection = writer.add_connection("/log", String.__msgtype__, typestore=store)
    for second in range(100):
        message = store.serialize_cdr(String(data=f"second {second}"), String.__msgtype__)
        writer.write(connection, (1710068400 + second) * 10**9, message)
# As the preset "resilient" does: WAL, and the last 40 messages after the last checkpoint.
database = sqlite3.connect(next((folder / "bag").glob("*.db3")))
database.execute("PRAGMA journal_mode = WAL")
database.execute("PRAGMA wal_autocheckpoint = 0")
late = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp").fetchall()[60:]
database.execute("DELETE FROM messages WHERE timestamp >= ?", (late[0][1],))
database.commit()
database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", late)
database.commit()
# The recorder loses power here: what lies on the disk is copied while the database is open.
killed = folder / "killed"
killed.mkdir()
for file in (folder / "bag").glob("*.db3*"):
    shutil.copy(file, killed / file.name)
database.close()

bag = next(killed.glob("*.db3"))
with Reader(bag) as reader:
    by_rosbags = sum(1 for _ in reader.messages())
copy = folder / "copy"
shutil.copytree(killed, copy)
by_sqlite = sqlite3.connect(copy / bag.name).execute("SELECT count(*) FROM messages").fetchone()[0]
print(f"rosbags {version('rosbags')}, SQLite {sqlite3.sqlite_version}")
print(f"messages written: 100; seen by SQLite: {by_sqlite}; seen by rosbags, without a warning: {by_rosbags}")
sys.exit(0 if (by_sqlite, by_rosbags) == (100, 60) else "this has changed")
PYTHON
