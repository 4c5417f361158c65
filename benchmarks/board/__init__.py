"""The board: agents by task, kind of lining and split, each between a floor and a ceiling.

roster (one line an agent) ─► columns (tunnels and episodes) ─► drive (one cell for a task and an agent) ─► cells
(read, intervals, leaks) ─► tables, picture, records
"""
