"""Pictures of a tunnel without a scene folder: its surfaces, a MuJoCo model of them, and a renderer.

plan ─► surfaces ─► stage (a MuJoCo model of a stretch) ─► renderer ◄─ robot
walls on the device ─► top_down (NumPy alone)
"""
