"""Trains a learnt localiser: `python -m train.locate --network kalman --out DIR`."""

import dataclasses
import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file
from subterra_jax.policies import TRAINED_UNDER, training_conditions
from subterra_jax.policies.files import SCHEMA
from subterra_jax.policies.locate.agent import KIND, flat
from train.locate import scores, tunnels
from train.locate.learner import LocateConfig, LocateLearner
from train.policies import facts_file
from train.world import library_versions

_EVERY = 20.0  # s between two lines of the log


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains a localiser, then scores it on drives in `val`.

    Attributes:
        out: Folder for `policy.safetensors` and its facts, `log.jsonl` and `scores.json`.
        task: Task that is driven, one that starts at a mouth.
        tunnels: Tunnels to learn in.
        val: Tunnels to score in.
        drives: Drives of the score.
        cache: Folder in which made tunnels are kept from run to run.
        config: Settings.
    """

    out: Path
    task: str = "Subterra/StopAt-v0"
    tunnels: str = "open:straight:train:0-15,open:cast:train:0-15,open:sprayed:train:0-15,open:masonry:train:0-15"
    val: str = "open:straight:val:0-9,open:cast:val:0-9,open:sprayed:val:0-9,open:masonry:val:0-9"
    drives: int = 512
    cache: Path | None = None
    config: Annotated[LocateConfig, tyro.conf.OmitArgPrefixes] = dataclasses.field(default_factory=LocateConfig)


def command(arguments: Command) -> None:
    """Trains, saves and scores."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    env, params, _ = tunnels.make(arguments.task, arguments.tunnels, cache=arguments.cache)
    print(f"{params.tunnel.count} tunnels: {time.monotonic() - started:.0f} s", flush=True)
    learner = LocateLearner(env, params, arguments.config)
    state = learner.init()
    state = train(learner, state, params, arguments)
    save(arguments.out / "policy.safetensors", state, env, params, arguments)
    env, params, names = tunnels.make(arguments.task, arguments.val, cache=arguments.cache)
    found = scores.score(arguments.config.network, state.weights, env, params, jax.random.key(2**20), arguments.drives)
    table = scores.by_kind(found, names)
    with replace_file(arguments.out / "scores.json") as fresh:
        facts = {"config": dataclasses.asdict(arguments.config), "steps": int(state.steps), "scores": table}
        fresh.write_text(json.dumps(facts, indent=1) + "\n")
    for kind, row in table.items():
        print(arguments.config.network, kind, {name: round(value, 3) for name, value in row.items()}, flush=True)


def train(learner: LocateLearner, state: Any, params: Any, arguments: Command) -> Any:
    """Trains until the time is over, and logs."""
    iterate, budget = jax.jit(learner.iterate, donate_argnums=0), 60.0 * arguments.config.minutes
    state, _ = iterate(state, params, jnp.float32(1.0))  # compiles
    jax.block_until_ready(state)
    started = told = time.monotonic()
    steps = 0
    with (arguments.out / "log.jsonl").open("w") as log:
        while (spent := time.monotonic() - started) < budget:
            state, terms = iterate(state, params, jnp.float32(1.0 - spent / budget))
            row = {name: float(value) for name, value in terms.items()}
            steps += learner.config.n_envs * learner.config.n_steps
            now = time.monotonic()
            rate = steps / (now - started)
            log.write(json.dumps({"seconds": now - started, "updates": int(state.steps), "rate": rate, **row}) + "\n")
            if now - told > _EVERY or spent == 0.0:
                told = now
                print(f"{now - started:.0f} s, {int(state.steps)} updates, {rate:,.0f} steps/s", row, flush=True)
    return state


def save(path: Path, state: Any, env: Any, params: Any, arguments: Command) -> None:
    """Writes weights and facts, as `st.load_policy` reads them."""
    named = {name: np.asarray(leaf, np.float32) for name, leaf in flat(jax.device_get(state.weights)).items()}
    content = safetensors.numpy.save(dict(sorted(named.items())))
    bounds = env.action_space(params)
    layout = {
        "network": arguments.config.network,
        "action_low": [float(x) for x in bounds.low[:2]],
        "action_high": [float(x) for x in bounds.high[:2]],
    }
    facts = {
        "schema": SCHEMA,
        "name": f"locate-{arguments.config.network}",
        "kind": KIND,
        "task": env.id,
        "layout": layout,
        "tensors_sha256": hashlib.sha256(content).hexdigest(),
        TRAINED_UNDER: training_conditions(env, params).to_json(),
        "config": dataclasses.asdict(arguments.config),
        "tunnels": arguments.tunnels,
        "updates": int(state.steps),
        "versions": library_versions(),
    }
    for place, data in ((path, content), (facts_file(path), f"{json.dumps(facts, indent=1)}\n".encode())):
        with replace_file(place) as fresh:
            fresh.write_bytes(data)


if __name__ == "__main__":
    sys.exit(
        run_command(lambda: command(parse(lambda words: tyro.cli(Command, args=words, prog="python -m train.locate"))))
    )
