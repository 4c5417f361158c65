"""This version, and messages about files and task ids of another."""

from collections.abc import Iterable

VERSION = "0.1.0"  # as in pyproject.toml, which a checkout on the path does not tell

BUILD_AGAIN = "build the scene again with `python -m scene.build`"
_UPDATE = "pip install --upgrade subterra-jax"


def other_schema(found: object, wanted: str, again: str) -> str:
    """Explains that a file has another schema than the reader's, and what to do about it.

    Args:
        found: The file's own field; None where it has none.
        wanted: The schema that is read, `NAME/NUMBER`.
        again: How to make such a file anew, as "build the scene again with `python -m scene.build`".

    Returns:
        The rest of a sentence that begins with the file's name.
    """
    name, _, number = wanted.rpartition("/")
    found_name, _, found_number = str(found).rpartition("/")
    if found_name != name or not found_number.isdigit():
        return f"field 'schema' must be {wanted!r}, is {'missing' if found is None else repr(str(found))}"
    if int(found_number) > int(number):
        return f"written by a newer Subterra (schema {found}; version {VERSION} reads {wanted}); {_UPDATE}"
    return f"written by an older Subterra (schema {found}; version {VERSION} reads {wanted}); {again}"


def no_task(task: str, known: Iterable[str]) -> str:
    """Explains in one sentence that a task id does not exist, and which id was probably meant.

    Args:
        task: The id as it was given, with `Subterra/` or without.
        known: The ids that exist.
    """
    known = tuple(known)
    name, _, number = task.removeprefix("Subterra/").partition("-v")
    alike = [candidate for candidate in known if candidate.removeprefix("Subterra/").partition("-v")[0] == name]
    if alike and (not number or f"Subterra/{task}" in alike):
        return f"no task {task!r}: its id is {f'Subterra/{task}' if number else alike[0]}"
    if alike:
        there_is = " and ".join(alike)
        return f"no task {task!r}: Subterra {VERSION} has {there_is}; results of two versions do not compare"
    return f"no task {task!r}; there are {', '.join(known)}"
