"""Identification of the stars on a photograph: by pattern alone, by a hint, and matching with the catalogue."""
