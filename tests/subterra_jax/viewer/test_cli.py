"""The command."""

import socket

import pytest

from subterra_jax.viewer.__main__ import main, parse_arguments
from subterra_jax.viewer.recording import save
from tests.subterra_jax.viewer.episodes import straight


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--scene", "nowhere"], "nowhere is no scene folder: scene.xml is missing"),
        (["--tunnel", "nowhere.npz"], "nowhere.npz: no such tunnel file"),
        (["--task", "Fly"], "no task 'Fly'; there are"),
        (["--driver", "nobody"], "no driver 'nobody'; there are"),
        (["--policy", "none.safetensors"], "none.safetensors: no such policy"),
        (["--replay", "none.npz"], "none.npz: no such recording"),
        (["--lining", "velvet"], "lining must be one of pockets, smooth, furnished, got 'velvet'"),
        (["--seed", "-1"], "seed must be 0 to"),
        (["--port", "70000"], "port must be 0 to 65535, got 70000"),
        (["--host", "203.0.113.7"], "cannot listen on 203.0.113.7"),
        (["--recordings", "/dev/null"], "/dev/null: is a file, so no folder"),
    ],
)
def test_a_mistake_ends_in_one_sentence_and_status_2(capsys, monkeypatch, tmp_path, arguments, says):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("subterra_jax.viewer.__main__._compile_once", lambda: None)
    assert main(["--port", "0", *arguments]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"error: {says}")
    assert (said.out, said.err.count("\n")) == ("", 1)


def test_a_taken_port_is_passed_over(monkeypatch):
    from subterra_jax.viewer.config import free_port

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) <= port + 19


def test_help_fits_a_screen_and_has_an_example(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_arguments(["--help"])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert len(told.splitlines()) <= 40
    assert "example: python -m subterra_jax.viewer" in told


def test_a_recording_may_lie_anywhere_when_the_command_names_it(tmp_path):
    save(straight(), tmp_path / "a.npz")
    assert parse_arguments(["--replay", str(tmp_path / "a.npz")]).replay == tmp_path / "a.npz"
