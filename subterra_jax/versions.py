"""Which version this is, and what to say of files and task ids of another."""

from collections.abc import Iterable

VERSION = "0.1.0"  # as in pyproject.toml, which a checkout on the path does not tell

_UPDATE = "pip install --upgrade subterra-jax"


def other_schema(found: object, wanted: str, again: str) -> str:
    """What is wrong with a file of another schema than the one that is read here, and what to do about it.

    Args:
        found: The file's own field; None where it has none.
        wanted: The schema that is read, `NAME/NUMBER`.
        again: How such a file comes about anew, as "build the scene again with `python -m scene.build`".

    Returns:
        The rest of a sentence that begins with the file's name.
    """
    name, _, number = wanted.rpartition("/")
    kind, _, told = str(found).rpartition("/")
    if kind != name or not told.isdigit():
        return f"field 'schema' must be {wanted!r}, is {'missing' if found is None else repr(str(found))}"
    if int(told) > int(number):
        return f"written by a newer Subterra (schema {found}; version {VERSION} reads {wanted}); {_UPDATE}"
    return f"written by an older Subterra (schema {found}; version {VERSION} reads {wanted}); {again}"


def no_task(task: str, known: Iterable[str]) -> str:
    """One sentence for a task id that there is not; of another version, or of a bare name, which id there is.

    Args:
        task: The id as it was given, with `Subterra/` or without.
        known: The ids that there are.
    """
    known = tuple(known)
    name, _, number = task.removeprefix("Subterra/").partition("-v")
    for there in known:
        if there.removeprefix("Subterra/").partition("-v")[0] == name:
            of_another = f"Subterra {VERSION} has {there}; results of two versions do not compare"
            return f"no task {task!r}: {of_another if number else f'its id is {there}'}"
    return f"no task {task!r}; there are {', '.join(known)}"
