"""Pictures: `kinds` of lining, a `scene`, and the `paper`'s figures."""
