"""``index.html``: a set of frames, or a score, as one page that opens in any browser without a network."""
