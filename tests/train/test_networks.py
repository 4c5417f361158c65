import jax
import jax.numpy as jnp
import numpy as np

from train import learning
from train.feedforward import networks
from train.policies import make_agent

LAYOUT = networks.Layout(18, (0.0, -1.5), (2.0, 1.5), 4, (16, 16), init_std=0.5, min_std=0.01)


def fresh():
    nets = networks.Networks(LAYOUT)
    return nets, nets.init(jax.random.PRNGKey(0)), learning.start_statistics((18,))


def test_actions_never_leave_their_range():
    nets, _, _ = fresh()
    raw = jnp.asarray(np.random.default_rng(0).normal(0.0, 20.0, (1000, 2)), jnp.float32)
    action = np.asarray(nets.action(raw))
    np.testing.assert_allclose(action.min(axis=0), LAYOUT.action_low, atol=1e-4)
    np.testing.assert_allclose(action.max(axis=0), LAYOUT.action_high, atol=1e-4)


def test_an_untrained_policy_drives_at_the_centre_of_the_range_with_the_spread_asked_for():
    nets, weights, statistics = fresh()
    stack = jnp.asarray(np.random.default_rng(1).normal(0.0, 3.0, (500, 4, 18)), jnp.float32)
    action = nets.act(networks.Policy(weights["policy"], statistics), stack)
    np.testing.assert_allclose(action, np.tile([1.0, 0.0], (500, 1)), atol=0.1)
    spread = nets.distribution.create_dist(nets.parameters(weights["policy"], statistics, stack)).scale
    np.testing.assert_allclose(spread, LAYOUT.init_std, atol=0.05)


def test_every_frame_of_the_stack_reaches_policy_and_value():
    nets, weights, statistics = fresh()

    def outputs(stack):
        parameters = nets.parameters(weights["policy"], statistics, stack)
        return nets.value(weights["value"], statistics, stack) + parameters.sum()

    gradient = np.asarray(jax.grad(outputs)(jnp.ones((4, 18))))
    assert (gradient != 0.0).all()


def test_an_image_is_seen_by_patches_and_its_release_drives_alike():
    layout = networks.Layout(6 + 32, (0.0, -1.0), (2.0, 1.0), 2, (16, 16), 0.5, 0.01, image=(4, 8), image_at=2)
    nets = networks.Networks(layout)
    weights = jax.jit(nets.init)(jax.random.key(0))
    assert weights["policy"]["params"]["patch"]["kernel"].shape == (32, 32)
    # The untrained policy is nearly constant.
    last = weights["policy"]["params"]["body"]["hidden_2"]
    last["kernel"] = jax.random.normal(jax.random.key(3), last["kernel"].shape)
    seen = 5.0 * jax.random.uniform(jax.random.key(1), (9, 2, 38))
    policy = networks.Policy(
        weights["policy"], learning.update_statistics(learning.start_statistics((38,)), seen[:, 0], ())
    )
    agent, act = make_agent(nets, policy), jax.jit(nets.act)
    answer = jax.jit(agent.answer)
    for stack in seen:
        np.testing.assert_allclose(answer(stack)[:2], act(policy, stack), atol=1e-5)
        for k in (0, 2, 33, 37):  # before, in and behind the image
            other = act(policy, stack.at[:, k].add(1.0))
            assert np.abs(other - act(policy, stack)).max() > 1e-6
