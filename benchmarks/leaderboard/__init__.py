"""Every agent on every task, on the fixed list of episodes.

config (tasks, agents, tunnels; a user's own files) ─► entries (evaluate, or read from an earlier run) ─► report
"""
