"""The files of an image: its formats, the camera's processing, EXIF, FITS headers and masks."""
