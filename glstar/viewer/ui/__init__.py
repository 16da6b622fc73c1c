"""The panels of the viewer, drawn with imgui."""
