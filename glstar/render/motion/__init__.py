"""The motion of the camera over an exposure, the paths of stars on the image, and the trail models that hold both."""
