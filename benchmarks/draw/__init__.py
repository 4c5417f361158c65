"""Pictures: `kinds` of lining, an `atlas` of where walls tell the station, a `scene`, and the `paper`'s figures."""
