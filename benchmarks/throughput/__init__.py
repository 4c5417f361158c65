"""Speed of the batched environment and of JaxNav, measured in one run with the exactness of its LiDAR.

config ─► measure (ours, floor, exactness), variants, peers ─► timing ─► report, figures
"""
