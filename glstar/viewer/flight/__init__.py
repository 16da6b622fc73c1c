"""The flight shown, from a log or a link: its play head, and what is known at a time and along the flight."""
