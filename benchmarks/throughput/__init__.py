"""Speed of the batched environment and of its peers, measured in one run with the exactness of its LiDAR.

config ─► measure (ours, floor, exactness), variants, peers, mujoco_route ─► timing ─► report
"""
