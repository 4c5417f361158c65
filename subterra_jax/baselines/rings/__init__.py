"""Counting the rings of the lining, without a map and without learning."""
