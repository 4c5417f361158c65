"""PPO in the manner of CleanRL: one file of torch over a Gymnasium vector environment.

It needs torch, which comes with `pip install 'subterra-jax[sb3]'`. In Gymnasium's usual autoreset mode the step after
the last of an episode only resets; it is left out of the loss.
"""

from typing import Any

import gymnasium
import jax
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RescaleAction, TransformObservation
from torch import nn
from watch import Act, OnHost, Watch, features

N_ENVS, N_STEPS, N_EPOCHS, N_MINIBATCHES = 64, 128, 4, 8
LEARNING_RATE, DISCOUNT, GAE_LAMBDA, CLIP, ENTROPY = 1e-3, 0.997, 0.95, 0.2, 1e-3


def layer(n_in: int, n_out: int, gain: float) -> nn.Linear:
    """Returns a dense layer with orthogonal weights and no bias at first."""
    made = nn.Linear(n_in, n_out)
    nn.init.orthogonal_(made.weight, gain)
    nn.init.zeros_(made.bias)
    return made


def tower(n_in: int, n_out: int, gain: float) -> nn.Sequential:
    """Returns a perceptron with two hidden layers of 64."""
    root = 2.0**0.5
    return nn.Sequential(
        layer(n_in, 64, root), nn.Tanh(), layer(64, 64, root), nn.Tanh(), layer(64, n_out, gain)
    )  # fmt: skip


class Agent(nn.Module):
    """Policy and value; actions are in units of half their range."""

    def __init__(self, n_obs: int, n_action: int) -> None:
        super().__init__()
        self.mean, self.value = tower(n_obs, n_action, 0.01), tower(n_obs, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((n_action,), -0.5))

    def policy(self, obs: torch.Tensor) -> torch.distributions.Normal:
        """Returns the distribution of actions."""
        return torch.distributions.Normal(self.mean(obs), self.log_std.exp())


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    envs: Any = gymnasium.make_vec(
        f"subterra_jax:{watch.task}",
        num_envs=N_ENVS,
        vectorization_mode="vector_entry_point",
        flat=True,
        **watch.options,
    )
    one = np.ones(watch.env.action_size, np.float32)
    look = jax.jit(jax.vmap(features(watch.env, watch.params)))
    n = look(envs.observation_space.sample()).shape[1]
    spaces = [gymnasium.spaces.Box(-np.inf, np.inf, shape) for shape in ((N_ENVS, n), (n,))]
    seen = TransformObservation(envs, lambda obs: np.asarray(look(obs)), *spaces)
    envs = normal = NormalizeObservation(RescaleAction(seen, -one, one))
    envs = NormalizeReward(envs, gamma=DISCOUNT)
    low, high = watch.env.action_space(watch.params).low, watch.env.action_space(watch.params).high
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    adam = torch.optim.Adam(agent.parameters(), LEARNING_RATE, eps=1e-5)

    def normalised(obs: np.ndarray) -> torch.Tensor:
        return torch.as_tensor((obs - normal.obs_rms.mean) / np.sqrt(normal.obs_rms.var + 1e-8), dtype=torch.float32)

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        action = agent.mean(normalised(np.asarray(look(obs)))).clamp(-1.0, 1.0).numpy()
        return low + 0.5 * (action + 1.0) * (high - low)

    driver = Act(OnHost(act))
    obs = torch.as_tensor(envs.reset(seed=seed)[0], dtype=torch.float32)
    over = torch.zeros(N_ENVS, dtype=torch.bool)
    for count in range(1, steps // (N_ENVS * N_STEPS) + 1):
        rows = []
        with torch.no_grad():
            for _ in range(N_STEPS):
                policy = agent.policy(obs)
                action = policy.sample()
                following, reward, terminated, truncated, _ = envs.step(action.clamp(-1.0, 1.0).numpy())
                following = torch.as_tensor(following, dtype=torch.float32)
                log_prob, (value, after) = policy.log_prob(action).sum(-1), agent.value(torch.stack([obs, following]))
                ended, done = torch.as_tensor(terminated), torch.as_tensor(terminated | truncated)
                reward = torch.as_tensor(reward, dtype=torch.float32)
                rows.append((obs, action, log_prob, value[:, 0], after[:, 0], reward, ended, done, ~over))
                obs, over = following, done
        seen, action, log_prob, value, after, reward, terminated, done, counts = (
            torch.stack(column) for column in zip(*rows, strict=True)
        )
        delta = reward + DISCOUNT * ~terminated * after - value
        advantage, carried = torch.zeros_like(delta), torch.zeros(N_ENVS)
        for t in reversed(range(N_STEPS)):
            carried = delta[t] + DISCOUNT * GAE_LAMBDA * ~done[t] * carried
            advantage[t] = carried
        flat = [part[counts] for part in (seen, action, log_prob, advantage, advantage + value)]
        for _ in range(N_EPOCHS):
            for chosen in torch.randperm(int(counts.sum())).chunk(N_MINIBATCHES):
                some = [part[chosen] for part in flat]
                loss = _loss(agent, *some)
                adam.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                adam.step()
        if watch(count * N_ENVS * N_STEPS, driver):
            break
    envs.close()


def _loss(
    agent: Agent, obs: torch.Tensor, action: torch.Tensor, old: torch.Tensor, gain: torch.Tensor, target: torch.Tensor
) -> torch.Tensor:
    """Returns the clipped objective, the value's error and the bonus for randomness of one minibatch."""
    policy = agent.policy(obs)
    ratio = (policy.log_prob(action).sum(-1) - old).exp()
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    objective = torch.min(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain).mean()
    error = (agent.value(obs)[:, 0] - target).square().mean()
    return -objective + 0.5 * error - ENTROPY * policy.entropy().sum(-1).mean()
