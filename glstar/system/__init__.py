"""What glstar needs of the operating system and its own installation: files, signals, bundled data."""
