"""`python -m scene.limits [PART ...]`: the thresholds of a build with their units and reasons, as its code has them.

Settings, which a user may change, are listed by `python -m scene.build --help`.

Example: python -m scene.limits fitting.floor judging
"""

import ast
import dataclasses
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.errors import SubterraError

_SIMPLE = (ast.Constant, ast.Tuple, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop, ast.expr_context)


class Limit(NamedTuple):
    """One line of constants."""

    part: str  # Package and module
    name: str  # Name, or names
    value: str  # Value, or values
    words: str  # Unit and reason


def list_limits(*parts: str) -> Iterator[Limit]:
    """Yields the constants of the modules whose names begin with any of `parts`; those of all without."""
    for package in ("reading", "poses", "cleaning", "fitting", "judging", "writing"):
        for file in sorted((Path(__file__).parent / package).glob("*.py")):
            part, source = f"{package}.{file.stem}", file.read_text("utf-8")
            if parts and not part.startswith(parts):
                continue
            tokens = tokenize.generate_tokens(io.StringIO(source).readline)
            comments = [(one.start, one.string.lstrip("# ")) for one in tokens if one.type == tokenize.COMMENT]
            beside = {line: words for (line, _), words in comments}
            above = {line + 1: words for (line, column), words in comments if column == 0}
            for node in ast.parse(source).body:
                if isinstance(node, ast.Assign) and _is_numbers(node.value):
                    words = beside.get(node.end_lineno or 0) or above.get(node.lineno, "")
                    yield Limit(part, ast.unparse(node.targets[0]), ast.unparse(node.value), words)


def _is_numbers(value: ast.expr) -> bool:
    """Return whether an expression is made of numbers alone, or of an angle in degrees."""
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "np.deg2rad":
        return _is_numbers(value.args[0])
    nodes = list(ast.walk(value))
    numbers = (node.value for node in nodes if isinstance(node, ast.Constant))
    return all(isinstance(node, _SIMPLE) for node in nodes) and all(isinstance(n, int | float) for n in numbers)


@dataclasses.dataclass(frozen=True)
class LimitsConfig:
    """Command line of `python -m scene.limits`."""

    # Packages, or modules such as fitting.floor; all where none is given.
    parts: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[PART ...]")] = ()


def show(parts: tuple[str, ...]) -> None:
    """Prints the thresholds of a build with their units and reasons; raises `SubterraError` where a part is none."""
    for part in parts:
        if not any(list_limits(part)):
            known = sorted({limit.part for limit in list_limits()})
            raise SubterraError(f"no part {part!r} with thresholds; there are {', '.join(known)}")
    for limit in list_limits(*parts):
        print(f"{limit.part:20} {limit.name} = {limit.value}  # {limit.words}")


def main(words: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    config = parse(
        lambda given: tyro.cli(LimitsConfig, prog="python -m scene.limits", args=given, description=__doc__), words
    )
    return run_command(lambda: show(config.parts), mistakes=(SubterraError,))


if __name__ == "__main__":
    sys.exit(main())
