"""What an observer at a site sees at a time: the stars, the Sun, the Moon, the planets and satellites."""
