"""Which room may know which: the borders of the house."""

import ast
import builtins
import subprocess
import symtable
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("scene", "subterra_jax", "train", "benchmarks", "tests")
HOST = "subterra_jax.host"  # plumbing without jax, which `scene` may import, and nothing else of `subterra_jax`
MAY_IMPORT = {
    "scene": {HOST},
    "subterra_jax": set(),
    "train": {"subterra_jax"},
    "benchmarks": {"scene", "subterra_jax", "train"},
}


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module or "")
    return names


def room_of(module: str) -> str:
    """The room of a module; the host plumbing counts as one."""
    return HOST if f"{module}.".startswith(f"{HOST}.") else module.split(".")[0]


def files(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_the_rooms_below_it(room: str) -> None:
    assert files(room), f"{room} has no files"
    for path in files(room):
        others = {room_of(name) for name in imported(path)} & {*ROOMS, HOST} - {room}
        if "subterra_jax" in {room, *MAY_IMPORT[room]}:
            others -= {HOST}
        assert others <= MAY_IMPORT[room], f"{path.relative_to(ROOT)} imports {others - MAY_IMPORT[room]}"


def test_scene_never_imports_jax() -> None:
    for path in files("scene"):
        assert not {name.split(".")[0] for name in imported(path)} & {"jax", "flax", "optax", "brax"}, path


@pytest.mark.parametrize("module", ["scene.build", "scene.survey.__main__", "subterra_jax.host.command"])
def test_scene_and_the_host_plumbing_load_no_jax(module: str) -> None:
    lines = f"import sys, {module}; sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", lines], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_survey_and_builder_share_no_code() -> None:
    for path in files("scene"):
        from_scene = {name for name in imported(path) if name == "scene" or name.startswith("scene.")}
        in_survey = path.is_relative_to(ROOT / "scene" / "survey")
        crossing = {name for name in from_scene if name.startswith("scene.survey") != in_survey}
        assert not crossing, f"{path.relative_to(ROOT)} imports {crossing}"


def tables(table: symtable.SymbolTable) -> Iterator[symtable.SymbolTable]:
    yield table
    for inside in table.get_children():
        yield from tables(inside)


def unknown(source: str, name: str) -> set[str]:
    """Names that a module, or what is in it, looks up and that neither it nor Python makes."""
    whole = symtable.symtable(source, name, "exec")
    used, made = set(), {"__file__", "__name__", "__path__", "__doc__", *dir(builtins)}
    for table in tables(whole):
        for symbol in table.get_symbols():
            own = symbol.is_parameter() or symbol.is_assigned()  # a function called `top` is taken for the module
            if symbol.is_referenced() and (table is whole or (symbol.is_global() and not own)):
                used.add(symbol.get_name())
            if (symbol.is_assigned() or symbol.is_imported()) and (table is whole or symbol.is_declared_global()):
                made.add(symbol.get_name())
    annotations = [node.annotation for node in ast.walk(ast.parse(source)) if isinstance(node, ast.AnnAssign)]
    shapes = {node.id for one in annotations for node in ast.walk(one) if isinstance(node, ast.Name)}
    return used - made - shapes  # nobody looks up what is said of a local variable


def test_no_name_is_used_that_nobody_made() -> None:
    """The linters are told to leave names alone: shapes of arrays look like some."""
    for room in ROOMS:
        for path in files(room):
            assert not unknown(path.read_text(), str(path)), f"{path.relative_to(ROOT)}"


def test_a_name_that_nobody_made_is_noticed() -> None:
    assert unknown("def f(x):\n    return x + Y", "there") == {"Y"}
    assert not unknown("from a import Y\ndef f(x):\n    return x + Y", "there")


def arrows(sources: dict[str, str]) -> dict[str, set[str]]:
    """Which files each file imports, wherever in it; `from package import module` is an arrow to the module."""
    found: dict[str, set[str]] = {}
    for module, source in sources.items():
        taken = found[module] = set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                taken |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                taken |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
        taken &= set(sources)
    return found


def circles(sources: dict[str, str]) -> list[set[str]]:
    """Groups of files of which each leads to all others."""
    leads_to = arrows(sources)
    reached = {}
    for module in leads_to:
        seen, waiting = set(), [module]
        while waiting:
            new = leads_to[waiting.pop()] - seen
            seen |= new
            waiting += new
        reached[module] = seen
    groups = {frozenset({one, *(b for b in there if one in reached[b])}) for one, there in reached.items()}
    return [set(group) for group in groups if len(group) > 1]


def test_no_two_files_import_each_other() -> None:
    """A package's `__init__` that only hands names on is no file of its own."""
    sources = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): path.read_text()
        for room in ROOMS
        for path in files(room)
        if path.name != "__init__.py"
    }
    assert not circles(sources)


def test_a_circle_is_noticed_wherever_the_import_stands() -> None:
    late = "def f():\n    from room.a import g"
    assert circles({"room.a": "import room.b", "room.b": "from room import c", "room.c": late}) == [
        {"room.a", "room.b", "room.c"}
    ]
    assert not circles({"room.a": "import room.b", "room.b": "import room.c", "room.c": ""})
