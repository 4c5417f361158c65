"""The parts of Brax that are used here.

Importing them loads MuJoCo, which prints to stdout what it did not find; the commands of this room keep stdout for
their own answers (`--json` is one line), so the import happens with stdout closed. Brax's own PPO trainer is not used:
it calls `jax.device_put_replicated`, which jax 0.10 no longer has.
"""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from brax.training.acme import running_statistics
    from brax.training.distribution import NormalTanhDistribution
    from brax.training.networks import MLP

__all__ = ["MLP", "NormalTanhDistribution", "running_statistics"]
