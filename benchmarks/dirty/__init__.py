"""Builds from clouds as scanners leave them, judged against truth: what was built, refused, or wrong without a word."""
