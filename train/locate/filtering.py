"""Puts a Kalman filter behind a trained localiser: `python -m train.locate.filtering POLICY --out DIR`.

The network stays as it is. What is learnt is how it measures a metre, with what error, and the sizes of what lasts over
a drive. The network's rows are computed once, so that a CPU is enough.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from subterra_jax.policies import load
from subterra_jax.policies.locate import kalman, memory, streams
from subterra_jax.policies.locate.agent import Locating, nested
from subterra_jax.policies.locate.blocks import Block
from train import tunnels
from train.config import ConfigError, at_least, positive
from train.locate import scores
from train.locate.command import Command as Training
from train.locate.drives import Drive, record_drives
from train.locate.keeping import CURVE, LOG, POLICY, SCORES, save
from train.locate.learner import LocateConfig, count, loss

_KINDS = ("straight", "cast", "sprayed", "masonry")
_BATCH, _VAL_SEED, _OWN_SEED = 16, 2**20, 2**21


@dataclasses.dataclass(frozen=True)
class Command:
    """Puts a Kalman filter behind a trained localiser.

    Attributes:
        policy: A localiser of `train.locate`, with a network and without a filter.
        out: Folder for `policy.safetensors` and its facts, `scores.json`, `log.jsonl` and `curve.jsonl`.
        task: Task that is driven.
        tunnels: Tunnels to learn in: of `train`, but others than those of the network, which knows these by heart.
        val: Tunnels to score in.
        drives: Drives to learn from, recorded once.
        val_drives: Drives of the score.
        updates: Steps of the optimiser.
        minibatch: Drives in one step.
        learning_rate: Of Adam at the beginning; it falls to 0.
        seed: Seed of drives and order.
        cache: Folder in which made tunnels are kept from run to run.
    """

    policy: tyro.conf.Positional[Path]
    out: Path
    task: str = "Subterra/StopAt-v1"
    tunnels: str = ",".join(f"open:{kind}:train:16-27" for kind in _KINDS)
    val: str = ",".join(f"open:{kind}:val:0-9" for kind in _KINDS)
    drives: int = 384
    val_drives: int = 256
    updates: int = 600
    minibatch: int = 32
    learning_rate: float = 0.01
    seed: int = 0
    cache: Path | None = None


@struct.dataclass
class Rows:
    """Drives as the network saw them.

    Attributes:
        blocks: Metres, of which a filter reads the odometer and the steps.
        hidden: Rows of the network.
        truth: True less commanded distance after each metre, m.
        valid: Metres that were completed.
    """

    blocks: Block
    hidden: Float[Array, "metre n"]
    truth: Float[Array, "metre"]
    valid: Bool[Array, "metre"]


def command(arguments: Command) -> None:
    """Records, learns, saves and scores.

    Raises:
        ConfigError: A setting is wrong, or the policy is no localiser that can have a filter.
        SubterraError: There is no such policy, task or tunnel.
    """
    at_least(arguments, 1, "drives", "val_drives", "updates", "minibatch")
    positive(arguments, "learning_rate")
    agent, facts = load(arguments.policy)
    if not isinstance(agent, Locating) or agent.network not in memory.CELLS:
        raise ConfigError(f"{arguments.policy}: is no localiser with a network of {', '.join(memory.CELLS)}")
    weights, network = nested(agent.tensors), agent.network
    rows, val_tunnel = {}, np.zeros(0, int)
    for split, names in (("train", arguments.tunnels), ("val", arguments.val)):
        env, params = tunnels.enter(arguments.task, tunnels.load(tunnels.names_of(names), None, arguments.cache))
        n, seed = (
            (arguments.drives, _OWN_SEED + arguments.seed) if split == "train" else (arguments.val_drives, _VAL_SEED)
        )
        drives = record(env, params, seed, n, split == "val", agent.speed)
        rows[split] = look(network, weights, drives)
        val_tunnel = np.asarray(drives.tunnel)
        print(f"{split}: {n} drives", flush=True)
    val = rows["val"]
    before = scores.by_kind(
        judged(plain_answers(network, weights, val), val), val_tunnel, tunnels.names_of(arguments.val)
    )
    own, log = learn(network, weights, rows["train"], arguments)
    whole = {**{name: part for name, part in weights.items() if name != "out"}, **own}
    after = scores.by_kind(judged(answers_of(own, val), val), val_tunnel, tunnels.names_of(arguments.val))
    arguments.out.mkdir(parents=True, exist_ok=True)
    config = LocateConfig(**{**facts["config"], "network": f"{network}{memory.FILTERED}"})
    settings = Training(out=arguments.out, tunnels=f"{facts['tunnels']},{arguments.tunnels}", config=config)
    save(arguments.out / POLICY, whole, arguments.updates, arguments.seed, env, params, settings)
    curve = [{"seconds": 0.0, **before["all"]}, {"seconds": log[-1]["seconds"], **after["all"]}]
    lines = {
        SCORES: json.dumps({"scores": after, "without": before}, indent=1),
        LOG: "\n".join(map(json.dumps, log)),
        CURVE: "\n".join(map(json.dumps, curve)),
    }
    for name, content in lines.items():
        with replace_file(arguments.out / name) as fresh:
            fresh.write_text(f"{content}\n")
    for kind in after:
        print(kind, *(f"{word} {table[kind]['within']:.3f}" for word, table in (("without", before), ("with", after))))


def record(env: Any, params: Any, seed: int, n: int, plain: bool, speed: float | None) -> Drive:
    """Drives `n` robots; `plain` as an agent does, otherwise at speeds that vary up to `speed`, from anywhere."""
    steps = scores.steps_of(params, speed)
    drive = jax.jit(lambda key: record_drives(env, params, key, min(n, 64), steps, from_mouth=plain, speed=speed))
    parts = [drive(jax.random.fold_in(jax.random.key(seed), i)) for i in range(-(-n // 64))]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:n], *parts)


def look(network: str, weights: Any, drives: Drive) -> Rows:
    """Returns the rows that the network makes of drives."""

    def one(drive: Drive) -> Rows:
        n = scores.FARTHEST
        blocks = streams.metres(drive.record, weights.get("match"), n)
        hidden = memory.hidden_rows(network, weights, blocks)
        ends = jnp.arange(1.0, n + 1.0)
        truth = jnp.interp(ends, drive.record.driven, drive.moved) - ends
        blank = dataclasses.replace(blocks, evidence=jnp.zeros((n, 1)), raw=jnp.zeros((n, 1)))
        return Rows(blank, hidden, truth, streams.reached(drive.record, n))

    return jax.jit(lambda drives: jax.lax.map(one, drives, batch_size=_BATCH))(drives)


def answers_of(own: Any, rows: Rows) -> Any:
    """Returns the answers of the filter to drives."""
    one = lambda r: kalman.sequence(own["kalman"], r.blocks, memory.measured(own, r.hidden))  # noqa: E731
    return jax.jit(lambda rows: jax.vmap(one)(rows))(rows)


def plain_answers(network: str, weights: Any, rows: Rows) -> Any:
    """Returns the answers of the network without a filter."""
    return jax.jit(lambda rows: jax.vmap(lambda r: memory.summed(weights, r.hidden))(rows))(rows)


def judged(answers: Any, rows: Rows) -> scores.Found:
    """Returns what `scores.make_judge` does."""
    error = np.abs(np.asarray(answers.correction - rows.truth))
    use = np.asarray(rows.valid) & (np.arange(error.shape[1]) >= scores.FIRST - 1)
    count = np.maximum(use.sum(axis=1), 1)
    end = np.maximum(np.asarray(rows.valid).sum(axis=1) - 1, 0)
    at = np.arange(len(error))
    return {
        "within": np.where(use.any(axis=1), (use & (error <= 1.0)).sum(axis=1) / count, np.nan),
        "error": np.array([np.median(e[u]) if u.any() else np.nan for e, u in zip(error, use, strict=True)]),
        "claimed": np.exp(np.asarray(answers.log_scale))[at, end],
        "found": error[at, end],
    }


def learn(network: str, weights: Any, rows: Rows, arguments: Command) -> tuple[Any, list[dict[str, float]]]:
    """Learns the filter and how the network measures; returns both, and the log."""
    fresh = memory.init(f"{network}{memory.FILTERED}", "match", jax.random.key(arguments.seed))
    out = weights["out"]
    # To begin with it measures what the network answers, all metres with the same error.
    measure = {
        "kernel": jnp.stack([out["kernel"][:, 0], jnp.zeros(len(out["kernel"]))], axis=1),
        "bias": jnp.stack([out["bias"][0], jnp.zeros(())]),
    }
    own = {"measure": measure, "kalman": fresh["kalman"]}
    schedule = optax.cosine_decay_schedule(arguments.learning_rate, arguments.updates)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule, b2=0.99))

    @jax.jit
    def update(own: Any, moments: Any, rows: Rows, chosen: Array) -> Any:
        some = jax.tree.map(lambda leaf: leaf[chosen], rows)
        counts = count(some.valid)
        (total, terms), gradients = jax.value_and_grad(
            lambda own: loss(answers_of(own, some), some.truth, some.valid, counts), has_aux=True
        )(own)
        changes, moments = optimizer.update(gradients, moments, own)
        return optax.apply_updates(own, changes), moments, {"loss": total, **terms}

    moments, log, started = optimizer.init(own), [], time.monotonic()
    rng, n = np.random.default_rng(arguments.seed), len(rows.truth)
    for index in range(arguments.updates):
        chosen = rng.choice(n, min(arguments.minibatch, n), replace=False)
        own, moments, terms = update(own, moments, rows, chosen)
        log.append({"seconds": round(time.monotonic() - started, 1), **{k: float(v) for k, v in terms.items()}})
        if index % 50 == 0:
            print(index, log[-1], flush=True)
    return own, log


def main() -> None:
    """Runs `python -m train.locate.filtering`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.locate.filtering", description=__doc__)


if __name__ == "__main__":
    main()
