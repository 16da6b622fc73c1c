"""The star catalogue: reading and building its file, names, and the stars of one epoch."""
