"""What several categories compute from a case: casts, grids, distances; each once a case or once a reference."""
