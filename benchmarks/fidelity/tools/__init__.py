"""Programs that made the frozen data of the suite."""
