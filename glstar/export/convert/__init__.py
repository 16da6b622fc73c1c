"""A complete export in the formats of other tools."""
