"""Trains a learnt localiser: `python -m train.locate --network kalman --out DIR`."""

import sys

import tyro

from subterra_jax.host.command import parse, run_command
from train.locate.command import Command
from train.locate.session import run
from train.options import insert_file

PROG = "python -m train.locate"


def read(words: list[str]) -> Command:
    """Reads the command line, and the file that it may name."""
    plain = (tyro.conf.FlagCreatePairsOff,)
    whole = insert_file(words, lambda some: tyro.cli(Command, args=some, prog=PROG, description=__doc__, config=plain))
    return tyro.cli(Command, args=whole, prog=PROG, description=__doc__, config=plain)


if __name__ == "__main__":
    sys.exit(run_command(lambda: run(parse(read))))
