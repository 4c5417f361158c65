"""This version, and messages about files of another."""

VERSION = "1.0.0"  # as in pyproject.toml, which a checkout on the path does not tell

BUILD_AGAIN = "build the scene again with `python -m scene.build`"
_UPDATE = "pip install --upgrade subterra-jax"


def other_schema(found: object, needed: str, again: str) -> str:
    """Explains that a file has another schema than the reader's, and what to do about it.

    Args:
        found: The file's own field; None where it has none.
        needed: The schema that is read, `NAME/NUMBER`.
        again: How to make such a file anew, as "build the scene again with `python -m scene.build`".

    Returns:
        The rest of a sentence that begins with the file's name.
    """
    name, _, number = needed.rpartition("/")
    found_name, _, found_number = str(found).rpartition("/")
    if found_name != name or not found_number.isdigit():
        return f"field 'schema' must be {needed!r}, is {'missing' if found is None else repr(str(found))}"
    if int(found_number) > int(number):
        return f"written by a newer Subterra (schema {found}; version {VERSION} reads {needed}); {_UPDATE}"
    return f"written by an older Subterra (schema {found}; version {VERSION} reads {needed}); {again}"
