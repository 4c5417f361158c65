"""The folder of a training of localisers: refused if it holds another, cleared, written, gone on with after a kill."""

import dataclasses
import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors.numpy

from subterra_jax.host.files import replace_file, require_folder
from subterra_jax.policies import TRAINED_UNDER, training_conditions
from subterra_jax.policies.files import SCHEMA
from subterra_jax.policies.locate.agent import KIND, flat
from train.checkpoint import FOLDER, has_checkpoint, remove_folder
from train.config import ConfigError
from train.folder import RunFolderError
from train.locate.command import Command, identity
from train.options import settings_of
from train.policies import facts_file
from train.sinks import TENSORBOARD
from train.world import library_versions

POLICY, LOG, CURVE, SCORES, CONFIG = "policy.safetensors", "log.jsonl", "curve.jsonl", "scores.json", "config.json"


def save(path: Path, weights: Any, updates: int, seed: int, env: Any, params: Any, arguments: Command) -> None:
    """Writes weights and facts, as `st.load_policy` reads them."""
    named = {name: np.asarray(leaf, np.float32) for name, leaf in flat(jax.device_get(weights)).items()}
    content = safetensors.numpy.save(dict(sorted(named.items())))
    bounds = env.action_space(params)
    layout: dict[str, Any] = {
        "network": arguments.config.network,
        "action_low": [float(x) for x in bounds.low[:2]],
        "action_high": [float(x) for x in bounds.high[:2]],
    }
    if arguments.config.speed is not None:
        layout["speed"] = arguments.config.speed
    facts = {
        "schema": SCHEMA,
        "name": f"locate-{arguments.config.network}",
        "kind": KIND,
        "task": env.id,
        "layout": layout,
        "tensors_sha256": hashlib.sha256(content).hexdigest(),
        TRAINED_UNDER: _conditions(env, params),
        "config": dataclasses.asdict(arguments.config),
        "seed": seed,
        "tunnels": arguments.tunnels,
        "world": {"tunnel": arguments.tunnels, "lining": None, "sensor": arguments.sensor},
        "updates": updates,
        "versions": library_versions(),
    }
    for place, data in ((path, content), (facts_file(path), f"{json.dumps(facts, indent=1)}\n".encode())):
        with replace_file(place) as fresh:
            fresh.write_bytes(data)


def _conditions(env: Any, params: Any) -> dict[str, Any]:
    """Returns the conditions of the training; a localiser reads ranges and numbers by name, among whatever fields."""
    return dataclasses.replace(training_conditions(env, params), fields=None).to_json()


def check_same(arguments: Command, was: dict[str, Any] | None) -> None:
    """Refuses to go on with a run that was begun with other settings.

    Raises:
        ConfigError: Naming the first that differs.
    """
    other = [name for name, value in identity(arguments).items() if was is None or was.get(name) != value]
    if other:
        raise ConfigError(f"{arguments.out}: was begun with another {other[0]}; train into another folder")


def check_folder(arguments: Command) -> None:
    """Refuses a folder that holds a run, unless it is to be gone on with as what it was, or thrown away."""
    require_folder(arguments.out)
    place = arguments.out / CONFIG
    if arguments.resume:
        if has_checkpoint(arguments.out):
            return  # the checkpoint itself says what it is of
        if place.exists():
            try:
                was = json.loads(place.read_text())["settings"]
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ConfigError(f"{place}: cannot be read; --overwrite begins anew") from error
            check_same(arguments, was)
        print(f"{arguments.out}: no checkpoint yet; begins at the beginning", file=sys.stderr)
    elif not arguments.overwrite and (has_checkpoint(arguments.out) or place.exists()):
        raise RunFolderError(f"{arguments.out}: holds a run already; --resume goes on with it, --overwrite replaces it")


def clear(out: Path) -> None:
    """Throws away what a folder holds of another run; the checkpoints first, which a later `--resume` believes."""
    remove_folder(out / FOLDER)
    for folder in out.glob("seed-*"):
        for place in (folder / POLICY, facts_file(folder / POLICY), folder / LOG, folder / CURVE, folder / SCORES):
            place.unlink(missing_ok=True)
        shutil.rmtree(folder / TENSORBOARD, ignore_errors=True)


def write_config(arguments: Command) -> None:
    """Writes what a run was begun with."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    facts = {
        "schema": "subterra.locate/1",
        "command": settings_of(arguments),
        "settings": identity(arguments),
        "versions": library_versions(),
    }
    with replace_file(arguments.out / CONFIG) as fresh:
        fresh.write_text(json.dumps(facts, indent=1) + "\n")


def append(path: Path, row: dict[str, Any]) -> None:
    """Adds a line to a log."""
    with path.open("a") as log:
        log.write(json.dumps(row) + "\n")


def forget(folder: Path, seconds: float) -> None:
    """Leaves out the lines of a log after the checkpoint that is gone on from."""
    for name in (LOG, CURVE):
        if (path := folder / name).exists():
            # A line without its end is one that a kill cut off.
            lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
            with replace_file(path) as fresh:
                fresh.write_text("".join(line for line in lines if json.loads(line)["seconds"] <= round(seconds, 2)))
