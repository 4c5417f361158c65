"""Draws kinds of lining, an atlas of a tunnel, or a scene.

`python -m benchmarks.draw kinds|atlas|scene ...`; `--help` after one of them says more.
"""

import sys

from benchmarks.draw import atlas, kinds, scene

COMMANDS = {"kinds": kinds.main, "atlas": atlas.main, "scene": scene.main}


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] in COMMANDS:
        return COMMANDS[words[0]](words[1:])
    asked = bool(words) and words[0] in ("-h", "--help")
    found = (
        "" if asked else f"error: nothing to draw is named {words[0] if words else ''!r}; there are kinds, atlas, scene"
    )
    print(__doc__ if asked else found, file=sys.stdout if asked else sys.stderr)
    return 0 if asked else 2


if __name__ == "__main__":
    sys.exit(main())
