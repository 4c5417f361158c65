"""Help that fits a screen, and mistakes at a command line that are one sentence."""

import dataclasses

import pytest
import tyro

from scene.arguments import parse
from scene.build import command as build_command
from scene.survey.config import SurveyConfig


@dataclasses.dataclass(frozen=True)
class Rare:
    """What hardly anybody sets."""

    depth: float = 1.0
    """Of the thing, m."""


@dataclasses.dataclass(frozen=True)
class Common:
    """Does a thing.

    Example: python -m thing --out here
    """

    out: str
    """Where."""
    kind: int = 1
    """Which."""
    rare: Rare = dataclasses.field(default_factory=Rare)


def read(*words: str) -> Common:
    return parse(lambda given: tyro.cli(Common, args=given, prog="thing"), list(words))


def shown(capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as ended:
        read(*words)
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_a_command_line_without_a_mistake_is_read_as_tyro_reads_it(capsys):
    assert read("--out", "here", "--rare.depth", "2") == Common("here", rare=Rare(2.0))
    assert capsys.readouterr() == ("", "")


def test_help_shows_the_commands_own_options_and_names_the_other_groups(capsys):
    page = shown(capsys, "--help")
    assert "--kind INT" in page
    assert "Example: python -m thing" in page
    assert "Of the thing" not in page
    assert page.endswith("--help-all shows further options: rare.\n")


def test_all_help_shows_every_group(capsys):
    page = shown(capsys, "--help-all")
    assert "--kind INT" in page
    assert "--rare.depth FLOAT" in page


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "missing: --out STR"),
        (["--out"], "Missing value for argument '--out'"),
        (["--out", "x", "--kind", "many"], "Error parsing --kind: invalid literal for int() with base 10: 'many'"),
        (["--out", "x", "--colour", "red"], "Unrecognized options: --colour, red"),
        (["--out", "x", "left", "over"], "Unrecognized options: left, over"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_2(capsys, words, sentence):
    with pytest.raises(SystemExit) as ended:
        read(*words)
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {sentence}")
    assert told.endswith("; --help shows what there is\n")
    assert told.count("\n") == 1


@pytest.mark.parametrize("command", [build_command, SurveyConfig])
def test_the_help_of_this_room_fits_a_screen_and_has_an_example(capsys, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        parse(lambda words: tyro.cli(command, args=words), ["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 100
    assert any("Example: python -m scene." in line for line in lines)
