"""The documentation runs as printed, and its site is built without a warning and without the net."""

import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import tyro

from subterra_jax.baselines import registry
from subterra_jax.host.rover import rover_mjcf
from tests.test_extend import FILES, forget

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs" / "guide").glob("*.md")),
    *(ROOT / "docs" / f"{name}.md" for name in ("index", "tasks", "results")),
]
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
YAML = re.compile(r"```yaml\n(.*?)```", re.DOTALL)
SLOW = "<!-- slow -->\n"  # before a block: others do without it
OURS = ("scene", "train", "benchmarks", "subterra_jax")
ELSEWHERE = re.compile(r"""<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)=["']?(?:https?:)?//[^"' >]+""")
LOADED = re.compile(r"""(?:@import|url\()\s*["']?(?:https?:)?//[^"')]+""")


class _Read(BaseException):
    """A command line has been understood; nothing further is needed of it."""


def _commands() -> list[list[str]]:
    """Words of every command of ours that the pages print, in blocks and in tables."""
    found = []
    for page in PAGES:
        text = page.read_text()
        lines = [line for block in SHELL.findall(text) for line in block.replace("\\\n", " ").splitlines()]
        for line in (*lines, *re.findall(r"`(python -m [^`]*)`", text)):
            words = shlex.split(line, comments=True)
            if words[:2] == ["python", "-m"] and words[2].split(".")[0] in OURS:
                found.append(words[2:])
    return found


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in with a built scene and the files that the pages print; agents may be registered."""
    built = tmp_path / "build" / "tunnel" / "tunnel.npz"
    built.parent.mkdir(parents=True)
    with resources.as_file(resources.files("subterra_jax") / "data" / "subterra-351.npz") as packaged:
        shutil.copy(packaged, built)
    built.with_name("scene.xml").write_bytes(ElementTree.tostring(rover_mjcf()))
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    settings = YAML.search((ROOT / "docs" / "guide" / "train.md").read_text())
    assert settings is not None
    (tmp_path / "mine.yaml").write_text(settings[1])
    run = {"schema": "subterra.run/1", "command": {"task": "Subterra/TraverseShort-v1", "config": {"hidden": [64, 64]}}}
    (tmp_path / "out" / "short").mkdir(parents=True)
    (tmp_path / "out" / "short" / "config.json").write_text(json.dumps(run))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    forget()
    return tmp_path


def _blocks(page: Path, slow: bool) -> list[re.Match[str]]:
    """The Python of a page, with or without what takes long."""
    text = page.read_text()
    return [block for block in PYTHON.finditer(text) if slow or not text[: block.start()].endswith(SLOW)]


def _run(page: Path, blocks: list[re.Match[str]]) -> None:
    """Runs blocks one after another, as somebody does who pastes them into one session; a score is above 0."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks:
        exec(compile("\n" * block.string.count("\n", 0, block.start(1)) + block[1], str(page), "exec"), names)
    assert names.get("scores", {"success": 1.0})["success"] > 0.0


def _id(page: Path) -> str:
    return page.relative_to(ROOT).with_suffix("").as_posix().removeprefix("docs/")


@pytest.mark.parametrize("page", [page for page in PAGES if _blocks(page, slow=False)], ids=_id)
def test_the_python_of_a_page_runs_from_top_to_bottom(page: Path, reader: Path):
    _run(page, _blocks(page, slow=False))


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if SLOW in page.read_text()], ids=_id)
def test_the_python_of_a_page_runs_to_its_end(page: Path, reader: Path):
    _run(page, _blocks(page, slow=True))


def test_the_pages_have_python_and_commands_in_them():
    assert sum(len(PYTHON.findall(page.read_text())) for page in PAGES) >= 12
    assert len(_commands()) >= 25


def _lost(text: str) -> list[str]:
    """Paths of ours that a text names and that are not there."""
    named = re.findall(rf"`((?:{'|'.join((*OURS, 'tests', 'docs'))})/[\w./-]*)`", text)
    return [path for path in named if not (ROOT / path).exists()]


def test_files_and_folders_that_the_pages_name_are_there():
    """But for what failed, which names what was there on the day."""
    for page in {*PAGES, *(ROOT / "docs").rglob("*.md")} - {ROOT / "docs" / "failed.md"}:
        assert not (lost := _lost(page.read_text())), f"{page.relative_to(ROOT)}: {lost}"
    assert _lost("`train/nowhere.py`, `train/ppo.py` and `scene/`") == ["train/nowhere.py"]


def test_every_link_and_target_of_the_readme_and_every_room_exists():
    readme = PAGES[0].read_text()
    links = re.findall(r"\]\((?!https?:)([^)#]+)", readme)
    assert len(links) >= 10
    rooms = re.findall(r"^\| `([\w/]+/)` \|", (ROOT / "docs" / "design.md").read_text(), re.MULTILINE)
    assert len(rooms) >= 5
    for path in (*links, *rooms):
        assert (ROOT / path).exists(), path
    targets = set(re.findall(r"\bmake ([a-z-]+)(?=[ `])", readme))
    assert {"demo", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target


def _stopping(real: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that reads a command line, and then has nothing follow."""

    def read(*args: Any, **kwargs: Any) -> Any:
        real(*args, **kwargs)
        raise _Read

    return read


@pytest.fixture(scope="module")
def command_line() -> Callable[[list[str]], None]:
    """Reads a command line as its module does, and stops there."""

    def read(words: list[str]) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", words)
            readers: list[tuple[Any, str]] = [(tyro, "cli"), (tyro.extras, "subcommand_cli_from_dict")]
            for room, name in readers:
                patch.setattr(room, name, _stopping(getattr(room, name)))
            with pytest.raises(_Read):
                runpy.run_module(words[0], run_name="__main__", alter_sys=False)

    return read


def _as_argparse(words: list[str]) -> None:
    from subterra_jax.viewer.__main__ import parse_arguments

    parse_arguments(words[1:])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_every_command_is_understood_by_its_module(command_line: Callable[[list[str]], None], reader: Path):
    for words in _commands():
        try:
            (_as_argparse if words[0] == "subterra_jax.viewer" else command_line)(words)
        except SystemExit as ended:
            pytest.fail(f"python -m {shlex.join(words)}: exit status {ended.code}")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_command_with_an_unknown_option_is_noticed(command_line: Callable[[list[str]], None]):
    with pytest.raises(SystemExit):
        command_line(["train.evaluate", "--episods", "5"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it, with warnings as errors."""
    pytest.importorskip("mkdocs", reason="the documentation's tools are not installed: pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Documentation built" in done.stderr, "mkdocs is silent: what it does not say does not fail it either"
    return folder


def test_the_site_loads_nothing_from_elsewhere(site: Path):
    pages = list(site.rglob("*.html"))
    assert len(pages) >= 20
    for page in pages:
        found = [tag for tag in ELSEWHERE.findall(page.read_text()) if 'rel="canonical"' not in tag]
        assert not found, f"{page.relative_to(site)}: {found}"
    for sheet in site.rglob("*.css"):
        assert not LOADED.findall(sheet.read_text()), sheet.relative_to(site)


def test_tables_and_lists_of_the_pages_are_laid_out(site: Path):
    for page in site.rglob("*.html"):
        text = re.sub(r"<!-- records\n.*?-->", "", page.read_text(), flags=re.DOTALL)  # templates of tables
        for left in ("<p>| ", "\n| ", "|---", "<br>- ", "<p>- ", "</div>\n- "):
            assert left not in text, f"{page.relative_to(site)}: {left!r}; a blank line is missing before it"


def test_the_reference_says_what_the_docstrings_say(site: Path):
    text = re.sub(r"<[^>]+>", "", (site / "api" / "environment.html").read_text())
    for said in (
        "Make an environment and its params.",
        "Take one step, without a reset at its end",
        "Let a policy drive",
    ):
        assert said in text
