"""Pictures: a `scene`, the `walls` of each kind, a `film`."""
