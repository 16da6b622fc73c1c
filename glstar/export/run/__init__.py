"""Drawing of the frames of an export: prepared, in one process or many, to a directory or a store, and verified."""
