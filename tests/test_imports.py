"""Which room may know which: the borders of the house."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

from tests import conftest

ROOT = Path(__file__).parents[1]
ROOMS = ("scene", "subterra_jax", "train", "benchmarks", "tests")
HOST = "subterra_jax.host"  # plumbing without jax, which `scene` may import, and nothing else of `subterra_jax`
MAY_IMPORT = {
    "scene": {HOST},
    "subterra_jax": set(),
    "train": {"subterra_jax"},
    "benchmarks": {"scene", "subterra_jax", "train"},
}


@functools.cache
def imports(source: str) -> tuple[set[str], set[str]]:
    """Modules that a file imports anywhere, and `package.name` of what it takes from them, which may be modules too."""
    nodes = [*ast.walk(ast.parse(source))]
    members = {f"{node.module}.{one.name}" for node in nodes if isinstance(node, ast.ImportFrom) for one in node.names}
    modules = {one.name for node in nodes if isinstance(node, ast.Import) for one in node.names}
    return modules | {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}, members


def imported(path: Path) -> set[str]:
    return imports(path.read_text())[0]


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


def test_scene_and_the_host_plumbing_load_no_jax_and_need_no_pye57() -> None:
    lines = "import sys; sys.modules['pye57'] = None\n"
    lines += "import subterra_jax.host.command, scene.build, scene.survey.__main__; sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", lines], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_survey_and_builder_share_no_code() -> None:
    for path in files("scene"):
        from_scene = {name for name in imported(path) if name == "scene" or name.startswith("scene.")}
        in_survey = path.is_relative_to(ROOT / "scene" / "survey")
        crossing = {name for name in from_scene if name.startswith("scene.survey") != in_survey}
        assert not crossing, f"{path.relative_to(ROOT)} imports {crossing}"


def circles(sources: dict[str, str]) -> list[set[str]]:
    """Groups of files of which each leads to all others."""
    # Which files each file imports; `from package import module` is an arrow to the module.
    leads_to = {module: set.union(*imports(one)) & set(sources) for module, one in sources.items()}
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
    late = "def f():\n    from room.a import g"  # wherever the import stands
    one = {"room.a": "import room.b", "room.b": "from room import c", "room.c": late}
    assert circles(one) == [{"room.a", "room.b", "room.c"}]


def test_what_the_list_of_slow_tests_names_is_there():
    lines = [line for line in conftest.SLOW.read_text().splitlines() if not line.startswith("#")]
    assert lines == sorted(set(lines))
    for line in lines:
        file, _, name = line.partition("[")[0].partition("::")
        assert f"def {name}" in (ROOT / file).read_text(), line
