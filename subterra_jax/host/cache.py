"""Where the package keeps on disk what it can make again: under `~/.cache/subterra`, or `XDG_CACHE_HOME`."""

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Return the folder of one kind of content; it need not exist, and may be deleted at any time."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "subterra" / name


def make_writable(folder: Path) -> bool:
    """Make a folder if it is not there, and tell whether it can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
