"""glstar: what a camera bolted to an aircraft sees of the night sky during a long exposure."""
