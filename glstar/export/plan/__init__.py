"""The plan of an export: the frames of a flight or a data set, and the manifest that describes them."""
