"""The page in a real browser."""

import io
import subprocess
import sys
import time

import imageio.v3 as imageio
import numpy as np
import pytest

from subterra_jax.tunnel.sources import tunnel_digest
from subterra_jax.viewer.recording import save
from tests.subterra_jax import tunnels
from tests.subterra_jax.viewer.browser import CHROMIUM, chromium, open_page
from tests.subterra_jax.viewer.clients import heard, join
from tests.subterra_jax.viewer.episodes import straight

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    path = tunnels.write_tunnel(folder / "t.npz", tunnels.tunnel_arrays(tunnels.s_bend(260.0, 90.0)))
    save(straight(1201, tunnel_sha256=tunnel_digest(path), length=260.0), folder / "rec" / "drive.npz")
    return folder


@pytest.fixture(scope="module")
def command(folder):
    """The command as it runs, and its address."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "subterra_jax.viewer", "--port", "0", "--tunnel", str(folder / "t.npz")),
            *("--recordings", str(folder / "rec"), "--replay", str(folder / "rec" / "drive.npz")),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    url = process.stdout.readline().split()[0]
    yield process, url
    process.terminate()
    assert "Traceback" not in process.communicate(timeout=20)[1]


def seconds_of_cpu(pid):
    with open(f"/proc/{pid}/stat") as stat:
        return sum(int(ticks) for ticks in stat.read().split()[13:15]) / 100.0


def looks(png):
    """The part of a picture beside the panel, as numbers."""
    return imageio.imread(io.BytesIO(png), extension=".png")[150:, :850, :3].astype(float)


def shown(page):
    """The time that the page shows, s."""
    return float(page.value("document.body.innerText.match(/([0-9.]+) s of [0-9.]+ s/)?.[1] || -1"))


def test_the_first_frame_takes_less_than_5_s_of_a_free_core(command):
    process, url = command
    with join(url) as link:
        while not any(message["type"] == "MeshMessage" for message in heard(link, 30.0)):
            pass
    assert seconds_of_cpu(process.pid) < 5.0


def test_an_episode_plays_in_the_browser_and_a_closed_tab_hurts_nobody(command, folder, tmp_path):
    _, url = command
    with chromium(tmp_path / "profile") as browser:
        page = open_page(browser, url)
        page.until("!!document.querySelector('canvas') && / s of /.test(document.body.innerText)", 60.0)
        before = shown(page)
        page.until(f"parseFloat(document.body.innerText.match(/([0-9.]+) s of/)?.[1]) > {before + 2.0}", 60.0)
        page.click("Pause")
        page.until("[...document.querySelectorAll('button')].some(b => b.textContent.trim() === 'Play')", 30.0)
        time.sleep(3.0)
        first = looks(page.screenshot())
        assert first.std() > 15.0
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
        stopped = shown(page)
        page.click("Play")
        page.until(f"parseFloat(document.body.innerText.match(/([0-9.]+) s of/)?.[1]) > {stopped + 3.0}", 60.0)
        assert np.abs(looks(page.screenshot()) - first).mean() > 1.0
        assert page.errors == []
        page.close()

        other = open_page(browser, url)
        other.until("/ s of /.test(document.body.innerText)", 60.0)
        before = shown(other)
        other.until(f"parseFloat(document.body.innerText.match(/([0-9.]+) s of/)?.[1]) != {before}", 60.0)
        other.click("Files")
        other.until("[...document.querySelectorAll('button')].some(b => b.textContent.trim() === 'Save picture')", 30.0)
        other.click("Save picture")
        waited = time.monotonic()
        while not (pictures := list((folder / "rec").glob("*.png"))):
            assert time.monotonic() - waited < 60.0
            time.sleep(0.2)
        assert imageio.imread(pictures[0])[..., :3].std() > 15.0
        assert other.errors == []
