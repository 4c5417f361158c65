"""One run on many devices: parts of its environments, and compiler options."""

import copy
import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from train.config import ConfigError, TrainConfig
from train.report import Report


def compiler_options(config: TrainConfig) -> dict[str, str | bool] | None:
    """Returns compiler options under which one seed gives one result, where the settings ask for it.

    A CPU needs none. On a GPU, XLA otherwise chooses kernels by timing them, and two runs of one seed part after an
    iteration or two. Measured on an H200, the deterministic kernels cost PPO about 3 % of its speed.
    """
    needed = config.sums == "ordered" and jax.default_backend() != "cpu"
    return {"xla_gpu_deterministic_ops": True} if needed else None


T = TypeVar("T")
L = TypeVar("L")
Parts = tuple[str, ...]


class Whole:
    """Base of a learner that is not split: `place`, `share` and `gather` as `Spread` has them."""

    def place(self, state: T) -> T:
        """Puts a state from a checkpoint on the device."""
        return jax.tree.map(jnp.asarray, state)

    def share(self, tree: T) -> T:
        """Returns data that all parts read, unchanged."""
        return tree

    def gather(self, state: T) -> T:
        """Returns the state, unchanged."""
        return state


def with_seed(learner: L, seed: int) -> L:
    """Returns a learner that differs by its seed alone: tables of the map are made once for all seeds."""
    other: Any = copy.copy(learner)
    other.config = dataclasses.replace(other.config, seed=seed)
    return other


def mean_over_parts(tree: T, parts: Parts) -> T:
    """Averages every leaf over all parts, which are of one size."""
    return jax.lax.pmean(tree, parts) if parts else tree


def own_key(key: PRNGKeyArray, parts: Parts) -> PRNGKeyArray:
    """Returns a key of its own for each part; it depends on the number of the part, not on its device."""
    return jax.random.fold_in(key, jax.lax.axis_index(parts)) if parts else key


def normalised(values: Float[Array, "..."], parts: Parts) -> Float[Array, "..."]:
    """Subtracts the mean over all parts, and divides by the standard deviation."""
    centre = mean_over_parts(jnp.mean(values), parts)
    spread = jnp.sqrt(mean_over_parts(jnp.mean(jnp.square(values - centre)), parts))
    return (values - centre) / (spread + 1e-8)


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
        self.learner, self.config, self.driver = learner, learner.config, learner.driver
        n_parts, found = self.config.parts, jax.devices() if devices is None else devices
        if n_parts < 2:
            raise ConfigError(f"parts must be at least 2 to be spread over devices, got {n_parts}")
        n_devices = max(n for n in range(1, len(found) + 1) if n_parts % n == 0)
        self.mesh = Mesh(np.array(found[:n_devices]), (DEVICE,))

    def init(self, key: Any, params: Any) -> Any:
        """Returns the state of an untrained run."""
        n_here = self.config.parts // self.mesh.size
        one_device = jax.vmap(
            self.learner.init, in_axes=None, out_axes=self._fields(0, None), axis_name=PART, axis_size=n_here
        )
        return self._over_devices(one_device, (_SHARED, _SHARED), self._fields(_HERE, _SHARED))(key, params)

    def iterate(self, state: Any, params: Any) -> tuple[Any, Report]:
        """Runs one iteration of all parts."""
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
        """Returns the policy that would drive next."""
        return self.learner.policy_of(state)

    def place(self, state: Any) -> Any:
        """Puts a state from a checkpoint on its devices."""
        fields = self._fields(_HERE, _SHARED)
        return jax.tree.map(self._put, fields, state, is_leaf=lambda x: isinstance(x, PartitionSpec))

    def share(self, tree: Any) -> Any:
        """Puts data that all parts read on every device."""
        return self._put(_SHARED, tree)

    def _put(self, spec: PartitionSpec, tree: Any) -> Any:
        where = NamedSharding(self.mesh, spec)
        return jax.tree.map(
            lambda x: jax.make_array_from_callback(np.shape(x), where, lambda index: np.asarray(x)[index]), tree
        )

    def gather(self, state: Any) -> Any:
        """Fetches the whole state to the host."""
        return jax.device_get(state)

    def _fields(self, of_parts: Any, common: Any) -> Any:
        """Returns a state with one value in place of each of its fields."""
        state_type = self.learner.state_type
        names = [field.name for field in dataclasses.fields(state_type)]
        return state_type(**{name: of_parts if name in _OF_PARTS else common for name in names})

    def _over_devices(self, function: Callable[..., Any], given: Any, made: Any) -> Callable[..., Any]:
        return jax.shard_map(function, mesh=self.mesh, in_specs=given, out_specs=made, check_vma=False)
