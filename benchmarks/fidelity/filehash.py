"""SHA-256 of recordings and files, as a scene's manifest has them."""

from pathlib import Path

from scene.resume import input_record


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of the names and hashes of a folder's files: what the builder records of its inputs."""
    return str(input_record([path])[0]["sha256"])
