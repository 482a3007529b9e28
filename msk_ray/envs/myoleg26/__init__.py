"""Two legs of 26 muscles under one trunk, built here."""
