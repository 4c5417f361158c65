"""Host plumbing of every room: errors, commands, files and versions. Never imports jax.

It lives in `subterra_jax` because the wheel ships that package alone, and the viewer, the recorder and the adapters
need it there. `scene` may import it, and nothing else of `subterra_jax`: importing the package loads no jax.
"""
