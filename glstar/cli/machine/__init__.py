"""Commands on this machine and glstar itself: its speed, libraries, catalogues, settings and manual."""
