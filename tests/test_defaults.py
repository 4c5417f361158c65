"""Every default number of a setting or an argument is what users have had; see `tests.recorded`."""

import ast
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = Path(__file__).with_name("defaults.txt")


def defaults(tree: ast.Module | ast.ClassDef | ast.FunctionDef, place: str) -> Iterator[tuple[str, str]]:
    """Defaults of fields and arguments by place, as the code has them."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield from defaults(node, f"{place}.{node.name}")
        if isinstance(node, ast.FunctionDef):
            takes = node.args
            named = [*takes.posonlyargs, *takes.args][::-1]
            pairs = [
                *zip(named, takes.defaults[::-1], strict=False),
                *zip(takes.kwonlyargs, takes.kw_defaults, strict=True),
            ]
            yield from ((f"{place}.{node.name}.{name.arg}", ast.unparse(one)) for name, one in pairs if one)
        if isinstance(node, ast.AnnAssign) and node.value and isinstance(tree, ast.ClassDef):
            yield f"{place}.{ast.unparse(node.target)}", ast.unparse(node.value)


def test_defaults_are_what_they_were():
    """Those that are gone or new are nobody's fault."""
    files = [path for room in ("subterra_jax", "scene", "train", "benchmarks") for path in (ROOT / room).rglob("*.py")]
    rooms = {path.relative_to(ROOT).with_suffix("").as_posix(): ast.parse(path.read_text()) for path in files}
    now = dict(pair for name, tree in sorted(rooms.items()) for pair in defaults(tree, name))
    now = {place: text for place, text in now.items() if text in ("True", "False") or any(map(str.isdigit, text))}
    if os.environ.get("SUBTERRA_WRITE_VALUES"):
        TABLE.write_text("".join(f"{place} = {text}\n" for place, text in now.items()))
    before = dict(line.split(" = ", 1) for line in TABLE.read_text().splitlines())
    assert {place: text for place, text in before.items() if now.get(place, text) != text} == {}
