"""Quantities of a case that several categories need: casts, grids, distances; each once a case or once a reference."""
