"""All metrics of a case."""

from collections.abc import Callable, Collection

from benchmarks.fidelity import registry, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.memory import give_back
from benchmarks.fidelity.value import Value


def evaluate(
    case: Case,
    categories: Collection[str] | None = None,
    reuse: dict[str, Value] | None = None,
    advance: Callable[[str], None] = lambda id: None,
) -> dict[str, Value]:
    """Raw values by id, in the order of the table.

    Args:
        case: What is judged and against what.
        categories: Only these are computed; the others come from `reuse`.
        reuse: Values of a case that differs in nothing that the other categories read.
        advance: Called with each id when it is done.
    """
    rows, values, last = table.load(), {}, ""
    for id, entry in registry.registered().items():
        category = rows[id].category
        if reuse is not None and categories is not None and category not in categories:
            values[id] = reuse[id]
        else:
            if category != last:
                case.let_go(last)
                give_back()
            values[id], last = registry.compute(case, id, entry), category
        advance(id)
    return values
