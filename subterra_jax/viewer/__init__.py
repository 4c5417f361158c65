"""A tunnel, a robot and what it believes, in the browser: `python -m subterra_jax.viewer`.

plan, scene folder ─► shapes ─► stage ◄─ player ◄─ recording ◄─ driving (env + agent)
                                  └────── session, panel, charts ──────┘
"""
