"""A learner whose environments are split into parts, which the devices of one host, or of several, share out.

Every part drives its own environments and learns from whole minibatches of them; gradients and statistics are averaged
over all parts. The parts of one device run side by side under `vmap`, so that four parts come to the same numbers on
one, two or four devices, but for the order of floating-point sums.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from train.devices.parts import Parts
from train.errors import ConfigError
from train.run.report import Report

DEVICE, PART = "device", "part"
SPLIT: Parts = (DEVICE, PART)
# What belongs to environments; all else is common to all parts.
_OF_PARTS = ("discounted", "drive")
_HERE, _SHARED = PartitionSpec(DEVICE), PartitionSpec()


class Spread:
    """`init` and `iterate` of a learner over all parts; what belongs to environments gets a part axis in front.

    Args:
        learner: Made with `axes` = (`PART`,) and `split` = `SPLIT`.
        devices: To use; as many of them as divide the parts. All there are if left out.
    """

    def __init__(self, learner: Any, devices: list[Any] | None = None) -> None:
        self.learner, self.config, self.networks = learner, learner.config, learner.networks
        n_parts, found = self.config.parts, jax.devices() if devices is None else devices
        if n_parts < 2:
            raise ConfigError(f"parts must be at least 2 to be spread over devices, got {n_parts}")
        n_devices = max(n for n in range(1, len(found) + 1) if n_parts % n == 0)
        if jax.process_count() > 1 and n_devices != len(found):
            raise ConfigError(f"parts = {n_parts} cannot be shared out among the {len(found)} devices of all processes")
        self.mesh = Mesh(np.array(found[:n_devices]), (DEVICE,))

    def init(self, key: Any, params: Any) -> Any:
        """The state of an untrained run."""
        n_here = self.config.parts // self.mesh.size
        one_device = jax.vmap(
            self.learner.init, in_axes=None, out_axes=self._fields(0, None), axis_name=PART, axis_size=n_here
        )
        return self._over_devices(one_device, (_SHARED, _SHARED), self._fields(_HERE, _SHARED))(key, params)

    def iterate(self, state: Any, params: Any) -> tuple[Any, Report]:
        """One iteration of all parts."""
        axes, specs = self._fields(0, None), self._fields(_HERE, _SHARED)
        one_device = jax.vmap(
            self.learner.iterate, in_axes=(axes, None), out_axes=(axes, Report(0, 0, None, None)), axis_name=PART
        )

        def with_news_of_all(state: Any, params: Any) -> tuple[Any, Report]:
            after, report = one_device(state, params)
            ended = jax.tree.map(lambda x: jax.lax.all_gather(x, DEVICE, axis=0, tiled=True), report.ended)
            return after, dataclasses.replace(report, ended=ended)

        made = (specs, Report(_HERE, _SHARED, _SHARED, _SHARED))
        return self._over_devices(with_news_of_all, (specs, _SHARED), made)(state, params)

    def policy_of(self, state: Any) -> Any:
        """The policy that would drive next."""
        return self.learner.policy_of(state)

    def place(self, state: Any) -> Any:
        """A state on the host, such as a checkpoint holds, where it belongs."""
        fields = self._fields(_HERE, _SHARED)
        return jax.tree.map(self._put, fields, state, is_leaf=lambda x: isinstance(x, PartitionSpec))

    def share(self, tree: Any) -> Any:
        """What all parts read, on every device."""
        return self._put(_SHARED, tree)

    def _put(self, spec: PartitionSpec, tree: Any) -> Any:
        where = NamedSharding(self.mesh, spec)
        return jax.tree.map(
            lambda x: jax.make_array_from_callback(np.shape(x), where, lambda index: np.asarray(x)[index]), tree
        )

    def gather(self, state: Any) -> Any:
        """A state on the host, whole; every process has to ask for it."""
        if jax.process_count() == 1:
            return jax.device_get(state)
        return multihost_utils.process_allgather(state, tiled=True)

    def _fields(self, of_parts: Any, common: Any) -> Any:
        """A state with one value in place of each of its fields."""
        state_type = self.learner.state_type
        names = [field.name for field in dataclasses.fields(state_type)]
        return state_type(**{name: of_parts if name in _OF_PARTS else common for name in names})

    def _over_devices(self, function: Callable[..., Any], given: Any, made: Any) -> Callable[..., Any]:
        return jax.shard_map(function, mesh=self.mesh, in_specs=given, out_specs=made, check_vma=False)
