"""The engine on Warp, MJX's back end for NVIDIA's GPUs: the same robot, window and model, about twice as fast."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float
from mujoco.mjx import warp

from subterra_jax.physics.engine import Body, Build, Engine, mjx
from subterra_jax.physics.ground import Window

INSTALLED: bool = warp.WARP_INSTALLED


@dataclasses.dataclass(frozen=True, eq=False)
class WarpEngine(Engine):
    """A robot in MJX by Warp where a program is made for a GPU, else by JAX.

    All robots of a batch share Warp's buffers, which hold every contact that they can have. Should Warp still tell that
    one was too small, the robots come back as NaN, which ends their episodes as any other fault of physics does. Warp
    adds up in no fixed order: the last bits differ from run to run.
    """

    on_cpu: bool = False  # Warp serves on a CPU too, slowly

    def run(self, body: Body, control: Float[Array, "n_servos"], window: Window, build: Build | None = None) -> Body:
        """Advance the robot by one control period; see `Engine.run`. Derivatives are those of JAX."""
        with jax.ensure_compile_time_eval():
            device = next(iter(jnp.zeros(()).devices()))  # that the program is made for
        if not self.on_cpu and device.platform != "gpu":
            return super().run(body, control, window, build)
        rows = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (body, control, window, build))
        return jax.tree.map(lambda leaf: leaf[0], self._run_batch(*rows))

    @functools.cached_property
    def _run_batch(self) -> Any:
        """Advances robots along one leading axis; a `vmap` of it makes that axis longer, so Warp sees one batch."""

        @custom_vmap
        def run(*given: Any) -> Body:
            return jax.vmap(functools.partial(self._advance, *self._in_warp(len(given[0].qpos))))(*given)

        @run.def_vmap
        def run_more(size: int, batched: Any, *given: Any) -> Any:
            def merged(leaf: Array, own: bool) -> Array:
                every = leaf if own else jnp.broadcast_to(leaf, (size, *leaf.shape))
                return every.reshape(size * every.shape[1], *every.shape[2:])

            after = run(*jax.tree.map(merged, given, tuple(batched)))
            split = jax.tree.map(lambda leaf: leaf.reshape(size, len(leaf) // size, *leaf.shape[1:]), after)
            return split, jax.tree.map(lambda leaf: True, split)

        whole, by_jax = jax.custom_jvp(run), jax.vmap(super().run)
        whole.defjvp(lambda before, change: jax.jvp(by_jax, before, change))
        return whole

    def _advance(self, model: Any, data: Any, body: Body, control: Any, window: Window, build: Build | None) -> Body:
        model = self.model_of(build, model)
        data = data.replace(ctrl=control, qpos=body.qpos, qvel=body.qvel, qacc_warmstart=body.warmstart, act=body.act)

        def substep(data: Any, _: None) -> tuple[Any, None]:
            return mjx.step(model, self.on_ground(data, window)), None

        with jax.default_matmul_precision("highest"):  # as for `Engine.run`
            after = lax.scan(substep, data, None, length=self.substeps)[0]
        kind = warp.mjwp_types.OverflowType
        # That the solver stops after its one or two iterations is meant.
        lost = after._impl.overflow & ~int(kind.ITERATIONS | kind.LS_ITERATIONS) != 0
        return Body(jnp.where(lost, jnp.nan, after.qpos), after.qvel, after.qacc_warmstart, after.act)

    @functools.cache  # noqa: B019  an engine lives as long as its programs
    def _in_warp(self, n: int) -> tuple[Any, Any]:
        """Model and empty data of a robot, with room for all contacts of `n` and for the constraints of one."""
        host = self.host
        rows = np.where(host.pair_dim == 1, 1, 2 * (host.pair_dim - 1)).sum() + host.jnt_limited.sum()
        with jax.ensure_compile_time_eval():
            model = mjx.put_model(host, impl="warp")
            data = mjx.make_data(host, impl="warp", naconmax=host.npair * n, naccdmax=0, njmax=int(rows))
        silent = dataclasses.replace(model.opt._impl, warn_overflow=0)  # or it prints in every step
        return model.replace(opt=model.opt.replace(_impl=silent)), data
