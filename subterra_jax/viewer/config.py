"""Config of the viewer, its errors, and the checks before it starts."""

import socket
from dataclasses import dataclass, field, replace
from pathlib import Path

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import require_folder
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.tasks import find


class ViewerError(SubterraError):
    """The viewer cannot start, or cannot show the choice."""


LOOPBACK = "127.0.0.1"
_PORTS_TRIED = 20
LININGS = ("pockets", "smooth", "furnished")


@dataclass(frozen=True)
class ViewerConfig:
    """Tunnels, task and driver to show, and the address to serve them at."""

    scene: Path | None = None  # scene folder with the lining, track and tunnel to show; `None`: no scene
    tunnels: tuple[str, ...] = ()  # further tunnel files, or names as for `load_tunnel`
    task: str = "Subterra/StopAt-v1"  # id of the first task, as `Subterra/StopAt-v1` or `StopAt`
    # first driver: a baseline, `policy:NAME`, `policy:FILE`, `policy:RUN-FOLDER`, `module:Class` or `FILE.py:Class`
    agent: str = "dead-reckoning"
    # trained policies, `.safetensors` files or run folders, offered beside the baselines
    policies: tuple[Path, ...] = field(default=())
    lining: str = "pockets"  # first variant of the walls
    # the robot's LiDAR, as for `subterra_jax.make`; of one in three dimensions the points are shown
    sensor: str = SENSORS[0]
    seed: int = 0  # seed of the first episode
    recordings: Path = Path("out/viewer")  # folder for saved episodes and pictures
    replay: Path | None = None  # first episode, if it is a recorded one
    host: str = LOOPBACK  # Address to listen on. The default is this machine alone.
    port: int = 8080  # first port to try


def check_config(config: ViewerConfig) -> ViewerConfig:
    """Check a config; return it with the task's full id.

    Raises:
        ViewerError: A folder or file is missing, the task does not exist, or a value is out of range.
    """
    if config.scene is not None:
        for needed in ("scene.xml", "tunnel.npz", "meshes"):
            if not (config.scene / needed).exists():
                raise ViewerError(f"{config.scene} is no scene folder: {needed} is missing")
    if config.recordings != ViewerConfig.recordings or config.recordings.exists():
        require_folder(config.recordings)  # the default folder need not be writable until something is saved
    if config.lining not in LININGS:
        raise ViewerError(f"lining must be one of {', '.join(LININGS)}, got {config.lining!r}")
    if config.sensor not in SENSORS:
        raise ViewerError(f"no sensor {config.sensor!r}; there are {', '.join(SENSORS)}")
    if not 0 <= config.seed < 2**31:
        raise ViewerError(f"seed must be 0 to {2**31 - 1}, got {config.seed}")
    if not 0 <= config.port < 2**16:
        raise ViewerError(f"port must be 0 to {2**16 - 1}, got {config.port}")
    return replace(config, task=find(config.task, short=True))


def free_port(host: str, port: int) -> int:
    """Find the first free port from `port` on; 0 is left to the system.

    Raises:
        ViewerError: The address is not this machine's, or all ports are taken.
    """
    cause: OSError | None = None
    for candidate in range(port, min(port + _PORTS_TRIED, 2**16)) if port else (0,):
        try:
            family = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
            return candidate
        except OSError as error:
            cause = error
    raise ViewerError(f"cannot listen on {host}, port {port} or the {_PORTS_TRIED - 1} after it ({cause})")
