"""Cloud or rings in, bore out: axis, sections, lining, and what of a track is seen."""
