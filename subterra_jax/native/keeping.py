"""Where machine code is kept on disk between processes."""

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jaxlib
import llvmlite.binding
import numba
import numba.core.config

config: Any = numba.core.config  # its attributes come from the environment


@contextlib.contextmanager
def code_kept() -> Iterator[bool]:
    """Lets numba keep what is compiled here in a folder of its own; gives False where none can be written.

    Numba numbers the files of one function in the order in which processes write them. Two that compile different
    versions of it at the same time would take the same number, and a third process would run the wrong one. So every
    version, of our sources, of the libraries and of the processor, has a folder to itself.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "subterra" / "native" / _version()
    before = config.CACHE_DIR
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        yield False
        return
    config.CACHE_DIR = str(folder)
    try:
        yield True
    finally:
        config.CACHE_DIR = before


def _version() -> str:
    """Digest of all that the machine code depends on."""
    sources = [file.read_bytes() for file in sorted(Path(__file__).parent.glob("*.py"))]
    features = llvmlite.binding.get_host_cpu_features().flatten()
    machine = f"{numba.__version__} {jaxlib.__version__} {llvmlite.binding.get_host_cpu_name()} {features}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:32]
