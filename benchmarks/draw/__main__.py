"""Draws a scene, walls, the film of an episode, or the transfer to a rover.

`python -m benchmarks.draw scene build/tunnel --out view.png`; so do `film`, `walls`,
`transfer`. `--help` after one of them says more.
"""

import sys
from importlib import import_module

from benchmarks.command import run_main
from subterra_jax.pictures.renderer import choose_gl

COMMANDS = {"scene": "RenderConfig", "film": "FilmConfig", "walls": "WallsConfig", "transfer": "TransferConfig"}


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] in COMMANDS:
        choose_gl()  # before anything imports MuJoCo
        module = import_module(f"benchmarks.draw.{words[0]}")
        return run_main(f"draw {words[0]}", getattr(module, COMMANDS[words[0]]), module.run, words=words[1:])
    if words and words[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    named = repr(words[0]) if words else "''"
    print(f"error: nothing to draw is named {named}; there are {', '.join(COMMANDS)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
