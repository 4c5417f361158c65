"""The viewer as its clients have it: over a socket, kind and unkind."""

import itertools
import random
import socket
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from subterra_jax.tunnel.sources import tunnel_digest
from subterra_jax.viewer.config import ViewerConfig, ViewerError
from subterra_jax.viewer.geometry import EpisodeGeometry
from subterra_jax.viewer.panel import legend, status_text
from subterra_jax.viewer.recording import load, save
from subterra_jax.viewer.session import Viewer
from tests.subterra_jax import tunnels
from tests.subterra_jax.viewer.clients import heard, join, say
from tests.subterra_jax.viewer.episodes import straight

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A tunnel, and an hour's drive in it that can be replayed."""
    folder = tmp_path_factory.mktemp("viewer")
    path = tunnels.write_tunnel(folder / "t.npz", tunnels.tunnel_arrays(tunnels.straight(60.0)))
    episode = straight(201, tunnel=str(path), tunnel_sha256=tunnel_digest(path))
    save(episode, folder / "rec" / "drive.npz")
    (folder / "secret.npz").write_bytes((folder / "rec" / "drive.npz").read_bytes())
    return folder


@pytest.fixture(scope="module")
def viewer(folder):
    config = ViewerConfig(
        tunnels=(str(folder / "t.npz"),), recordings=folder / "rec", replay=folder / "rec" / "drive.npz", port=0
    )
    viewer = Viewer(config)
    until(lambda: viewer.session.view.player.episode is not None)
    yield viewer
    viewer.stop()


def until(holds, seconds=20.0):
    began = time.monotonic()
    while not holds():
        assert time.monotonic() - began < seconds
        time.sleep(0.02)


def moves(viewer):
    """Tells if the replay goes on: the clock, and a client that hears the robot move."""
    player = viewer.session.view.player
    player.seek(0.0)
    if not player.playing:
        player.toggle()
    with join(viewer.url) as link:
        until(lambda: any(m["type"] == "SetPositionMessage" and m["name"] == "/robot" for m in heard(link, 10.0)))
    before = player.time
    until(lambda: player.time != before)
    return True


def test_the_episode_waits_for_the_first_visitor(folder):
    config = ViewerConfig(
        tunnels=(str(folder / "t.npz"),), recordings=folder / "rec", replay=folder / "rec" / "drive.npz", port=0
    )
    viewer = Viewer(config)
    player = viewer.session.view.player
    try:
        until(lambda: player.episode is not None)
        time.sleep(0.3)
        assert (player.playing, player.time) == (False, 0.0)
        with join(viewer.url):
            until(lambda: player.playing and player.time > 0.0)
        player.pause()
        with join(viewer.url):
            time.sleep(0.3)
        assert not player.playing, "a second visitor does not start what the first has stopped"
    finally:
        viewer.stop()


def test_beams_and_the_ends_of_trails_are_where_the_robot_is(viewer, plan_of):
    session = viewer.session
    session.view.player.pause()
    time.sleep(0.2)
    scene, episode = session.view.scene_view, session.view.player.episode
    for at in (30.4, 30.9, 31.3):  # faster than lines are sent
        moment = episode.moment(at)
        scene.show(episode, moment, False)
        for name, place, heading in (
            ("/carried", moment.position, moment.heading),
            ("/reckoned", moment.odometry, moment.odometry_heading),
        ):
            frame = scene._frames[name]
            np.testing.assert_allclose(frame.position, place)
            np.testing.assert_allclose(2.0 * np.arctan2(frame.wxyz[3], frame.wxyz[0]), heading, atol=1e-9)
    assert all(tail.visible for tail in scene._tails.values())
    scene.show(episode, episode.moment(2.0), False)
    assert not any(tail.visible for tail in scene._tails.values()), "a tail longer than the way"


def test_the_legend_names_what_is_shown_alone():
    whole = legend(straight())
    assert all(name in whole for name in ("truth", "odometry", "LiDAR", "estimate", "goal"))
    bare = legend(straight(goal=np.nan, estimate=np.full((21, 2), np.nan, np.float32)))
    assert "estimate" not in bare
    assert "goal" not in bare
    assert "error of odometry +" in status_text(straight(), 10, finished=True)


def test_a_client_is_sent_tunnel_robot_and_controls(viewer):
    kinds, names = set(), set()
    with join(viewer.url) as link:
        while not {"MeshMessage", "GlbMessage", "GuiSliderMessage", "GuiUplotMessage", "LineSegmentsMessage"} <= kinds:
            for message in heard(link, 10.0):
                kinds.add(message["type"])
                names.add(str(message.get("name")))
    assert {"/robot", "/ghost", "/truth", "/odometry", "/carried/estimate", "/carried/beams", "/carried/tail"} <= names


def test_the_server_side_makes_at_least_30_frames_a_second_of_351_m(viewer, plan_of):
    session = viewer.session
    title = "subterra-351"
    centreline = session.view.tunnel_view.show(title, "pockets", 1e9)
    episode = EpisodeGeometry(straight(3001, length=centreline.plan.length), centreline)
    session.view.scene_view.set_episode(episode, centreline)
    with join(viewer.url) as link:
        drain = threading.Thread(target=lambda: [heard(link, 1.0) for _ in range(20)], daemon=True)
        drain.start()
        began, n = time.thread_time(), 60
        for row in range(n):
            session.view.show(episode, episode.moment(2000.0 + row), False)
        took = time.thread_time() - began
        drain.join()
    assert n / took > 30.0
    session.view.tunnel_view.show(str(viewer.session.panel.choice.tunnel), "smooth", 60.0)


def test_what_is_saved_can_be_replayed(viewer, folder):
    session = viewer.session
    name = session.save()
    assert load(folder / "rec" / straight(tunnel=str(folder / "t.npz")).file_name).agent == "by hand"
    assert session.panel.recorded.value in name
    session.view.player.seek(5.0)
    session.panel.list_recordings(("drive.npz",), "drive.npz")
    session.replay()
    until(lambda: session.view.player.time < 5.0)


def test_it_listens_on_this_machine_alone(viewer):
    port = viewer.server.get_port()
    assert viewer.url == f"http://127.0.0.1:{port}"
    with socket.socket() as other:
        assert other.connect_ex(("127.0.0.2", port)) != 0


@pytest.mark.parametrize("path", ["/../secret.npz", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..\\..\\x"])
def test_it_hands_out_no_file_of_this_machine(viewer, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(viewer.url + path)


def test_a_page_from_elsewhere_may_not_use_it(viewer):
    def listen():
        with join(viewer.url, page="http://elsewhere.example") as link:
            for _ in range(100):
                heard(link, 10.0)

    with pytest.raises(ConnectionClosed):
        listen()


def test_a_recording_outside_the_folder_is_not_read(viewer):
    session = viewer.session
    for name in ("../secret.npz", "/etc/passwd", "rec/drive.npz"):
        with pytest.raises(ViewerError, match="no recording"):
            session._library.load_recording(name)


def nonsense(viewer, seed):
    """Messages of an unkind client: noise, half messages, and real controls set to what they cannot be."""
    draw = random.Random(seed)
    panel = viewer.session.panel
    uuids = [handle._impl.uuid for handle in (panel.play, panel.time, panel.tunnel, panel.seed, panel.recorded)]
    junk = [float("nan"), 1e300, -5, "x" * 5000, None, [], {"a": 1}, True, "../../etc/passwd", b"\x00"]
    values = [{"value": draw.choice(junk)}, {"removed": True}, {"update_cb": 3}, {"value": 1, "max": "y"}, {}, {"_": 0}]
    updates = [{"type": "GuiUpdateMessage", "uuid": draw.choice(uuids), "updates": v} for v in values]
    shares = [{"type": name} for name in ("ShareUrlRequest", "ShareUrlDisconnect", "NoSuchMessage", "Message")]
    camera = {"type": "ViewerCameraMessage", "position": ["a", None, {}], "wxyz": 3, "fov": float("inf")}
    render = {"type": "GetRenderResponseMessage", "payload": b"not a picture", "render_uuid": "0"}
    upload = {"type": "FileTransferStartUpload", "source_component_uuid": uuids[0], "transfer_uuid": "u"}
    upload |= {"filename": "../../x", "mime_type": "a/b", "part_count": 2**40, "size_bytes": 2**60}
    pointer = {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": "x"}
    raw = [draw.randbytes(draw.randrange(200)), b"", b"\xc1", "text", {"type": 5}, [1, 2], 7]
    said = [*updates, *shares, camera, render, upload, pointer, *raw]
    draw.shuffle(said)
    return said


def bother(viewer, seed):
    """One unkind client: says it all, over again after each time it is thrown out, and leaves without a word."""
    said = iter(nonsense(viewer, seed))
    for _ in range(3):
        try:
            link = join(viewer.url)
            for message in itertools.islice(said, 8):
                if isinstance(message, bytes | str):
                    link.send(message)
                else:
                    say(link, message)
            link.socket.close()
        except (OSError, ConnectionClosed, InvalidHandshake):
            continue


@pytest.mark.parametrize("n", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_nonsense_leaves_it_alive_and_as_it_was(viewer, monkeypatch, n):
    shared = []
    monkeypatch.setattr(viewer.server, "request_share_url", lambda *a, **k: shared.append(1))
    moves(viewer)
    choice, threads = viewer.session.panel.choice, threading.active_count()
    for seed in range(n):
        bother(viewer, seed)
    assert moves(viewer)
    assert viewer.session.panel.choice == choice
    assert not shared
    assert not viewer.server.gui._current_file_upload_states
    until(lambda: not viewer.server.get_clients())
    assert threading.active_count() < threads + 40


def test_a_tab_closed_while_playing_leaves_it_alive(viewer):
    for _ in range(3):
        link = join(viewer.url)
        heard(link, 10.0)
        link.socket.close()
    assert moves(viewer)


def test_sound_values_of_a_control_get_through(viewer):
    session = viewer.session
    with join(viewer.url) as link:
        heard(link, 10.0)
        say(link, {"type": "GuiUpdateMessage", "uuid": session.panel.speed._impl.uuid, "updates": {"value": "25 x"}})
        until(lambda: session.view.player.speed == 25.0)
        say(link, {"type": "GuiUpdateMessage", "uuid": session.panel.speed._impl.uuid, "updates": {"value": "2 x"}})
        until(lambda: session.view.player.speed == 2.0)
        say(link, {"type": "GuiUpdateMessage", "uuid": session.panel.time._impl.uuid, "updates": {"value": 11.0}})
        until(lambda: 10.9 < session.view.player.time < 13.0)
        playing = session.view.player.playing
        say(link, {"type": "GuiUpdateMessage", "uuid": session.panel.play._impl.uuid, "updates": {"value": True}})
        until(lambda: session.view.player.playing != playing)


def test_a_recording_of_a_tunnel_that_it_was_not_given_is_refused_in_a_sentence(viewer, folder):
    said = []
    viewer.session.worker._report_error = said.append
    save(straight(tunnel="elsewhere"), folder / "rec" / "other.npz")
    viewer.session.panel.list_recordings(("other.npz",), "other.npz")
    viewer.session.replay()
    until(lambda: said)
    assert "recorded in a tunnel 'elsewhere' that the viewer was not given" in said[0]
    viewer.session.worker._report_error = viewer.session.report_error


@pytest.mark.slow
def test_what_is_chosen_is_driven_when_a_browser_says_so(viewer):
    panel, player = viewer.session.panel, viewer.session.view.player
    wanted = [(panel.tunnel, "control"), (panel.task, "Subterra/TraverseShort-v1"), (panel.agent, "random")]
    with join(viewer.url) as link:
        for control, value in [*wanted, (panel.seed, 11), (panel.drive, True)]:
            say(link, {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}})
        until(lambda: player.episode.recording.agent == "random" and player.episode.finished, 120.0)
    driven = player.episode.recording
    assert (driven.tunnel, driven.lining, driven.task) == ("control", "smooth", "Subterra/TraverseShort-v1")
    assert (driven.seed, driven.length) == (11.0, 60.0)
    assert len(driven) > 100
