"""Every agent on every task, on the fixed list of episodes.

config ─► entries (drive, or read what an earlier run has driven) ─► board (scores) ─► report, figure
"""
