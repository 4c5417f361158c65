import pytest

from tests.train.conftest import call
from train import __main__ as navigate
from train import curve, evaluate, release

COMMANDS = {"": navigate, ".evaluate": evaluate, ".release": release, ".curve": curve}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_screen_and_has_an_example(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert call(COMMANDS[name].main, "--help") == 0
    page = capsys.readouterr().out
    assert f"python -m train{name} " in " ".join(page.split("\n\n", 1)[1].split())
    assert page.count("\n") <= 40
    assert max(map(len, page.splitlines())) <= 100


def test_the_settings_are_on_a_page_of_their_own(capsys):
    assert call(navigate.main, "--help") == 0
    short = capsys.readouterr().out
    assert "--learning-rate" not in short
    assert "--help-all shows further options:" in short
    assert call(navigate.main, "--help-all") == 0
    assert "--learning-rate" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "missing: --out PATH"),
        (("--out",), "Missing value for argument '--out'"),
        (("--out", "x", "--step-size", "3"), "Unrecognized options: --step-size, 3"),
        (("--out", "x", "--steps", "many"), "Error parsing --steps: invalid literal for int() with base 10: 'many'"),
        (("--out", "x", "--memory"), "argument --memory: expected one argument"),
    ],
)
def test_a_mistyped_command_line_is_one_sentence_and_status_2(words, message, capsys):
    assert call(navigate.main, *words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}")
    assert error.count("\n") == 1
