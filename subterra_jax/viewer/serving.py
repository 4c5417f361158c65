"""A server with the viewer on it."""

import contextlib
import io
from pathlib import Path

import viser

from subterra_jax.viewer.config import ViewerConfig, checked, free_port
from subterra_jax.viewer.guard import harden
from subterra_jax.viewer.library import Library
from subterra_jax.viewer.recording import load
from subterra_jax.viewer.session import Session


class Viewer:
    """A running viewer.

    Args:
        config: What to show.

    Attributes:
        url: Address of its page.
        session: What is on its stage.

    Raises:
        SubterraError: Something that was asked for is not there.
    """

    def __init__(self, config: ViewerConfig):
        config = checked(config)
        library = Library(config)
        replay = None if config.replay is None else load(Path(config.replay))
        port = free_port(config.host, config.port)
        with contextlib.redirect_stdout(io.StringIO()):  # its banner says less than the one line of the command
            self.server = viser.ViserServer(host=config.host, port=port, verbose=False)
        harden(self.server)
        self.session = Session(self.server, config, library)
        shown = "127.0.0.1" if config.host == "0.0.0.0" else config.host
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{self.server.get_port()}"
        self.session.start(replay)

    def stop(self) -> None:
        """Ends the session and the server."""
        self.session.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
