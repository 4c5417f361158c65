"""Agents that need no learning; `agent` says what an agent is."""
