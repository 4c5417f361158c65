"""Pictures: `kinds` of lining, a `scene`, the `paper`'s figures, a `film`."""
