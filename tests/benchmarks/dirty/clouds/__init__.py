"""Clouds with one trouble each, and exact truth: air cut out of rock, a scanner on a tripod, and what spoils its cloud.

Nothing is shared with the builder of `scene`, or with its simulated survey.
"""
