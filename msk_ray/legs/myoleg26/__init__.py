"""Two legs with 26 muscles under one trunk, built here."""
