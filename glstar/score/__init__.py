"""Scores: a navigator's answers to the frames of an export, against their truth."""
