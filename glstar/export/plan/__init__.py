"""What is to be drawn: the frames of a flight or a data set, and the manifest that describes them."""
