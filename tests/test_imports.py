"""Which room may know which: the borders of the house."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("scene", "subterra_jax", "train", "benchmarks", "tests")
MAY_IMPORT = {
    "scene": set(),
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


def files(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_the_rooms_below_it(room: str) -> None:
    assert files(room), f"{room} has no files"
    for path in files(room):
        others = {name.split(".")[0] for name in imported(path)} & set(ROOMS) - {room}
        assert others <= MAY_IMPORT[room], f"{path.relative_to(ROOT)} imports {others - MAY_IMPORT[room]}"


def test_scene_never_imports_jax() -> None:
    for path in files("scene"):
        assert not {name.split(".")[0] for name in imported(path)} & {"jax", "flax", "optax", "brax"}, path


def test_survey_and_builder_share_no_code_but_how_a_command_line_is_read() -> None:
    for path in files("scene"):
        from_scene = {name for name in imported(path) if name == "scene" or name.startswith("scene.")}
        in_survey = path.is_relative_to(ROOT / "scene" / "survey")
        crossing = {name for name in from_scene if name.startswith("scene.survey") != in_survey} - {"scene.arguments"}
        assert not crossing, f"{path.relative_to(ROOT)} imports {crossing}"
