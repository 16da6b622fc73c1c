"""The state of the viewer and what a user does to it: keys, actions, files and recordings; no window, no imgui."""
