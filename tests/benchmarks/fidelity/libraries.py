"""The libraries that the code of each metric can call, read from the syntax of the suite's modules."""

import ast
from functools import cache
from pathlib import Path

import benchmarks.fidelity

ROOM = "benchmarks.fidelity"
FOLDER = Path(benchmarks.fidelity.__file__).parent
NAMES = {
    "trimesh.ray.ray_pyembree": "embreex", "scipy.spatial.transform": "scipy.spatial", "scipy.sparse": "scipy.sparse",
    "scipy.sparse.csgraph": "scipy.sparse", "skimage": "scikit-image", "sklearn": "scikit-learn",
    "small_gicp": "small-gicp", "cc3d": "connected-components-3d", "mujoco.mjx": "mujoco-mjx",
}  # fmt: skip
NOT_COUNTED = {"numpy", "jaxtyping"}
STANDARD = {"collections", "dataclasses", "functools", "itertools", "typing", "pathlib", "io", "contextlib", "time",
            "hashlib", "importlib", "logging", "xml", "json", "csv", "math", "re", "sys", "os", "string", "zlib",
            "ctypes", "gc"}  # fmt: skip

Definition = tuple[str, str]  # module and name


def named(module: str) -> str | None:
    """The name under which a module is installed; `None` for what is not counted."""
    top = module.split(".")[0]
    if top in STANDARD | NOT_COUNTED:
        return None
    for prefix in (module, ".".join(module.split(".")[:2]), top):
        if prefix in NAMES:
            return NAMES[prefix]
    return ".".join(module.split(".")[:2]) if top == "scipy" else top


class Module:
    """One module: its definitions and what each of them refers to."""

    def __init__(self, name: str, path: Path) -> None:
        self.name = name
        self.tree = ast.parse(path.read_text())
        self.aliases: dict[str, tuple[str, str | None]] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    self.aliases[alias.asname or alias.name] = (node.module, alias.name)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    self.aliases[alias.asname or alias.name.split(".")[0]] = (alias.name, None)
        self.definitions: dict[str, ast.stmt] = {}
        for statement in self.tree.body:
            names = [statement.name] if isinstance(statement, ast.FunctionDef | ast.ClassDef) else []
            if isinstance(statement, ast.Assign | ast.AnnAssign):
                names = [n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)]
            self.definitions |= dict.fromkeys(names, statement)


@cache
def modules() -> dict[str, Module]:
    found = {}
    for path in sorted(FOLDER.rglob("*.py")):
        parts = path.relative_to(FOLDER).with_suffix("").parts
        name = ".".join((ROOM, *(parts[:-1] if parts[-1] == "__init__" else parts)))
        found[name] = Module(name, path)
    return found


def nodes(tree: ast.AST) -> list[ast.AST]:
    """All nodes but annotations: a type that is only named is not called."""
    found, left = [], [tree]
    while left:
        node = left.pop()
        found.append(node)
        for field, value in ast.iter_fields(node):
            if field not in ("annotation", "returns", "decorator_list"):
                left += [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, ast.AST)]
    return found


def references(module: Module, tree: ast.AST) -> tuple[set[Definition], set[str]]:
    """Definitions of the suite and other modules that a piece of syntax refers to."""
    ours: set[Definition] = set()
    others: set[str] = set()
    local = {n.id for n in nodes(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    local |= {n.arg for n in nodes(tree) if isinstance(n, ast.arg)}
    for node in nodes(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in module.aliases:
            source, name = module.aliases[node.value.id]
            if f"{source}.{name}" in modules():
                ours.add((f"{source}.{name}", node.attr))
        if not isinstance(node, ast.Name) or (node.id in local and isinstance(tree, ast.FunctionDef)):
            continue
        if node.id in module.definitions:
            ours.add((module.name, node.id))
        elif node.id in module.aliases:
            source, name = module.aliases[node.id]
            if source.startswith(ROOM):
                ours.add((source, name or ""))
            else:
                whole = f"{source}.{name}"
                others.add(whole if whole in NAMES or (source in ("scipy", "mujoco") and name != "MjModel") else source)
    return ours, others


@cache
def reached(start: Definition) -> frozenset[str]:
    """Names of the libraries that a definition leads to, by whatever it refers to."""
    seen, left, found = {start}, [start], set()
    while left:
        where, name = left.pop()
        module = modules().get(where)
        if module is None or name not in module.definitions:
            continue
        ours, others = references(module, module.definitions[name])
        found |= {label for other in others if (label := named(other))}
        left += ours - seen
        seen |= ours
    return frozenset(found)


@cache
def libraries() -> dict[str, str]:
    """What the column `lib` of the table must hold, by id of the metric."""
    made = {}
    for module in modules().values():
        if not module.name.startswith(f"{ROOM}.categories."):
            continue
        for name, statement in module.definitions.items():
            for decorator in getattr(statement, "decorator_list", ()):
                if not isinstance(decorator, ast.Call) or getattr(decorator.func, "id", "") not in ("metric", "family"):
                    continue
                members = [(decorator.args[0], None)]
                if decorator.func.id == "family":
                    table = decorator.args[1]
                    members = list(zip(table.keys, table.values, strict=True))
                for key, argument in members:
                    found = set(reached((module.name, name)))
                    if argument is not None:
                        ours, others = references(module, argument)
                        found |= {label for other in others if (label := named(other))}
                        found = found.union(*(reached(one) for one in ours))
                    made[key.value] = "; ".join(sorted(found)) or "numpy"
    return made
