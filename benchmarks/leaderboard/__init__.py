"""Every agent on every task, on the fixed list of episodes.

entries (tasks, agents and tunnels; evaluate, or read from an earlier run) ─► report (scores, Markdown, JSON, figure)
"""
