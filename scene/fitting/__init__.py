"""From a cloud or rings to the bore: axis, sections, lining, and the track that the cloud shows."""
