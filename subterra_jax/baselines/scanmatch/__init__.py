"""Scan matching against the last few scans, without a map."""
