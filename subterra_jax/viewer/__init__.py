"""A tunnel, a robot and its belief in the browser: `python -m subterra_jax.viewer`.

plan, scene folder ─► shapes ─► scene ◄─ player ◄─ recording ◄─ driving (env + agent)
                                  └────── session, panel, browsers ────┘
"""
