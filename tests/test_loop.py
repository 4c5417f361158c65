"""The page with a training loop: it runs as printed, its advantages are right, and it learns the task."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.learning import advantages

pytestmark = pytest.mark.door

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "loop.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def run(source):
    names = {"__name__": "__main__"}
    exec(compile(source, str(PAGE), "exec"), names)
    return names


@pytest.fixture(scope="module")
def page():
    """Names that the page makes but for its last two blocks, with a few small environments."""
    source = "\n".join(BLOCKS[:-2])
    return run(source.replace("= 16, 128, 128", "= 1, 8, 24"))


def test_the_advantages_of_the_page_are_those_of_the_trainer(page):
    env, key = page["batch"], jax.random.key(3)
    params = page["params"].replace(horizon=9)  # episodes end by the clock in the middle of the rollout
    page["params"] = params
    weights = page["init"](jax.random.key(0))
    obs, state = env.reset(jax.random.key(1), params, 8)
    _, _, rows = jax.jit(page["rollout"])(weights, obs, state, key)
    ended = np.asarray(rows["ended"])
    assert ended.any()
    going = jnp.asarray(1.0 - ended, bool)
    # The reward of the page holds the value after a truncation already; the trainer is given it apart.
    last = rows["advantage"][-1] + rows["value"][-1] - rows["reward"][-1]
    after = jnp.where(going[-1], last / page["DISCOUNT"], 0.0)
    expected = advantages(
        rows["reward"], rows["value"], after, jnp.zeros_like(rows["value"]), ~going, ~going, page["DISCOUNT"], 0.95
    )
    np.testing.assert_allclose(rows["advantage"], expected, rtol=1e-4, atol=1e-5)
    # A truncated step is worth more, or less, by the value of its final observation.
    assert np.abs(np.asarray(rows["reward"])[ended]).min() > 0.0


def test_one_iteration_of_the_page_changes_the_weights_and_keeps_them_finite(page):
    weights = page["init"](jax.random.key(0))
    obs, state = page["batch"].reset(jax.random.key(1), page["params"], 8)
    moments = page["optimizer"].init(weights)
    after, *_ = page["iterate"](weights, moments, obs, state, jax.random.key(2))
    for old, new in zip(jax.tree.leaves(weights), jax.tree.leaves(after), strict=True):
        assert np.isfinite(new).all()
        assert (np.asarray(old) != np.asarray(new)).any()


@pytest.mark.slow
def test_the_page_learns_the_task():
    names = run("\n".join(BLOCKS))
    assert names["records"].success.mean() >= 0.9
    assert names["records"].coverage.mean() >= 0.9
