"""Builds that are killed, or whose disk is full, leave the previous output as it was."""

import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from subterra_jax.host.errors import OutputError
from subterra_jax.host.files import replace_folder

ROOT = Path(__file__).parents[2]


def test_a_folder_is_replaced_and_a_half_done_replacement_is_put_right(tmp_path):
    out = tmp_path / "out"
    for text in ("old", "new"):
        with replace_folder(out) as folder:
            (folder / "a").write_text(text)
    assert (out / "a").read_text() == "new"
    out.rename(tmp_path / ".out.stale")  # as a kill between two renames leaves it
    (tmp_path / ".out.partial").mkdir()

    def fill_the_disk() -> None:
        with replace_folder(out) as folder:
            assert not list(folder.iterdir())
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        fill_the_disk()
    assert (out / "a").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def start(*arguments: object, limit: int | None = None) -> subprocess.Popen:
    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [sys.executable, "-m", "scene.build", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
    )


@pytest.mark.slow
def test_a_kill_while_writing_and_a_full_disk_leave_the_previous_output_whole(bore_file, tmp_path):
    out = tmp_path / "scene"
    out.mkdir()
    (out / "scene.xml").write_text("mine")
    build = start(bore_file, "--out", out)
    while build.poll() is None and not (tmp_path / ".scene.partial" / "scene.xml").exists():
        time.sleep(0.005)
    build.send_signal(signal.SIGKILL)
    assert build.wait() == -signal.SIGKILL
    assert (out / "scene.xml").read_text() == "mine"

    full = start(bore_file, "--out", out, limit=100_000)  # bytes a file
    said, error = full.communicate(timeout=120)
    assert full.returncode == 2, error
    assert re.fullmatch(rf"error: {re.escape(str(out))}: cannot be written \(.*\)\n", error), error
    assert (out / "scene.xml").read_text() == "mine"

    done = start(bore_file, "--out", out)
    said, error = done.communicate(timeout=120)
    assert done.returncode == 0, error
    assert (out / "scene.xml").read_text() != "mine"
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"], said
