"""The sensor: from starlight to digital numbers, point spread function, colour band and fixed pattern."""
