"""How fast the batched environment steps, beside its peers, in one run with the exactness of its LiDAR.

config ─► measure (ours), floor, peers/ ─► timing ─► report, figure, result
          exactness, variants (lengths, linings) ┘
"""
