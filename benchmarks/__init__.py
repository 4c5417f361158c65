"""Everything that scores: speed, fidelity and the demo."""
