"""Judges a built bore against all that the scanner saw: explained returns, unseen wall, and warnings."""
