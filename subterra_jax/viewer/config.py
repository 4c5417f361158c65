"""What the viewer is asked to show, and whether it can."""

import socket
from dataclasses import dataclass, field, replace
from pathlib import Path

from subterra_jax.b2 import MISSIONS
from subterra_jax.outputs import require_folder
from subterra_jax.tasks import TASKS
from subterra_jax.versions import no_task
from subterra_jax.viewer.errors import ViewerError

LOOPBACK = "127.0.0.1"
_PORTS_TRIED = 20
LININGS = ("pockets", "smooth", "furnished")


@dataclass(frozen=True)
class ViewerConfig:
    """What to show, and where to serve it.

    Attributes:
        scene: A scene folder, whose lining and track are shown and whose tunnel is driven in; None is none.
        tunnels: Further tunnel files, or names as for `load_tunnel`.
        task: Id of the first task, as `Subterra/StopAt-v0` or `StopAt`.
        agent: Name of who drives first.
        policies: Trained policies, `.safetensors` files, offered beside the baselines.
        lining: Variant of the walls to begin with.
        seed: Seed of the first episode.
        recordings: Folder in which episodes and pictures are saved, and from which episodes are replayed.
        replay: A recorded episode to begin with; None drives one.
        host: Address to listen on. The default is this machine alone.
        port: First port to try.
    """

    scene: Path | None = None
    tunnels: tuple[str, ...] = ()
    task: str = "Subterra/StopAt-v0"
    agent: str = "dead-reckoning"
    policies: tuple[Path, ...] = field(default=())
    lining: str = "pockets"
    seed: int = 0
    recordings: Path = Path("out/viewer")
    replay: Path | None = None
    host: str = LOOPBACK
    port: int = 8080


def checked(config: ViewerConfig) -> ViewerConfig:
    """The config with the task's id in full.

    Raises:
        ViewerError: A folder or file is not there, there is no such task, or a value is out of range.
    """
    if config.scene is not None:
        for needed in ("scene.xml", "tunnel.npz", "meshes"):
            if not (config.scene / needed).exists():
                raise ViewerError(f"{config.scene} is no scene folder: {needed} is missing")
    if config.recordings != ViewerConfig.recordings or config.recordings.exists():
        require_folder(config.recordings)  # where nobody named one, looking on works wherever one stands
    if config.lining not in LININGS:
        raise ViewerError(f"lining must be one of {', '.join(LININGS)}, got {config.lining!r}")
    if not 0 <= config.seed < 2**31:
        raise ViewerError(f"seed must be 0 to {2**31 - 1}, got {config.seed}")
    if not 0 <= config.port < 2**16:
        raise ViewerError(f"port must be 0 to {2**16 - 1}, got {config.port}")
    task = config.task if config.task in (*TASKS, *MISSIONS) else f"Subterra/{config.task}-v0"
    if task not in (*TASKS, *MISSIONS):
        raise ViewerError(no_task(config.task, (*TASKS, *MISSIONS)))
    return replace(config, task=task)


def free_port(host: str, port: int) -> int:
    """The first free port from one on; 0 is left to the system.

    Raises:
        ViewerError: The address is not this machine's, or all of them are taken.
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
