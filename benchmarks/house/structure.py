# SPDX-License-Identifier: Apache-2.0
"""Size and shape of the source tree: lines, names, parameters, constants, circles, function lengths.

    python benchmarks/house/structure.py [CHECKOUT ...]

One column per checkout (this one by default), so that two states can be compared. Read from the syntax trees alone;
nothing is imported.
"""

from __future__ import annotations

import argparse
import ast
import statistics
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[2]
Trees = dict[str, tuple[Path, ast.Module]]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT], help="folders with a src/ below them")
    checkouts = parser.parse_args().checkouts
    columns = [measure(read_trees(path)) | parameter_counts(path) for path in checkouts]
    print("| figure | " + " | ".join(path.resolve().name for path in checkouts) + " |")
    print("|---" * (len(checkouts) + 1) + "|")
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(column[name] for column in columns) + " |")


def read_trees(checkout: Path) -> Trees:
    """Every module below ``checkout/src``: dotted name to path and syntax tree."""
    trees: Trees = {}
    for path in sorted((checkout / "src").rglob("*.py")):
        parts = path.relative_to(checkout / "src").with_suffix("").parts[1:]
        if path.name == "setup.py" or "launch" in parts:
            continue
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        trees[name] = (path, ast.parse(path.read_text(encoding="utf-8")))
    return trees


def measure(trees: Trees) -> dict[str, str]:
    """The figures of one tree, as text."""
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path, _ in trees.values()}
    functions = [node for _, tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    lengths = [(node.end_lineno or node.lineno) - node.lineno + 1 for node in functions]
    longest = max(lines, key=lambda path: lines[path])
    classes = Counter(node.name for _, tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef))
    twice = sorted(name for name, count in classes.items() if count > 1 and not name.startswith("_"))
    return {
        "modules": str(len(trees)),
        "lines": str(sum(lines.values())),
        "public names": str(sum(len(list(public_names(tree))) for _, tree in trees.values())),
        "parameters of all configurations": str(sum(count_parameters(tree) for _, tree in trees.values())),
        "named and inline float constants": str(sum(count_constants(tree) for _, tree in trees.values())),
        "of these outside the drawings of the simulator": str(
            sum(count_constants(tree) for name, (_, tree) in trees.items() if "simulation" not in name)
        ),
        "class names that stand twice": f"{len(twice)} ({', '.join(twice)})" if twice else "0",
        "import circles of modules": str(len(circles(module_imports(trees)))),
        "import circles of folders": str(len(circles(folder_imports(trees)))),
        "median function, lines": f"{statistics.median(lengths):g}",
        "functions over 40 lines": str(sum(length > 40 for length in lengths)),
        "longest file, lines": f"{lines[longest]} ({longest.name})",
    }


def parameter_counts(checkout: Path) -> dict[str, str]:
    """How many ROS parameters the nodes declare; ``parameters.py`` lists them."""
    from parameters import declared_parameters  # beside this file: there when it runs as a script

    declared = declared_parameters(checkout)
    return {"declared ROS parameters": f"{len(declared)}, {len({(p.config, p.field) for p in declared})} distinct"}


def public_names(tree: ast.Module) -> Iterator[str]:
    """Names of a module that another may use: classes, functions and their public methods, constants."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name
            if isinstance(node, ast.ClassDef):
                members = (m.name for m in node.body if isinstance(m, ast.FunctionDef))
                yield from (f"{node.name}.{name}" for name in members if not name.startswith("_"))
        elif isinstance(node, ast.Assign):
            yield from (t.id for t in node.targets if isinstance(t, ast.Name) and not t.id.startswith("_"))


def count_parameters(tree: ast.Module) -> int:
    """Fields of configurations that are made by ``parameter(...)``."""
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return sum(isinstance(call.func, ast.Name) and call.func.id == "parameter" for call in calls)


def count_constants(tree: ast.Module) -> int:
    """Float literals other than 0, 0.5, 1 and 2 outside of parameters and tests of them."""
    inside = {
        id(leaf)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "parameter"
        for leaf in ast.walk(node)
    }
    floats = (
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, float) and id(node) not in inside
    )
    return sum(abs(node.value) not in (0.0, 0.5, 1.0, 2.0) for node in floats)


def module_imports(trees: Trees) -> dict[str, set[str]]:
    """Which modules of the tree each module imports at its top, those for type checkers included."""
    return {name: set(_imported(tree, trees)) - {name} for name, (_, tree) in trees.items()}


def _imported(tree: ast.Module, trees: Trees) -> Iterator[str]:
    guarded = (inner for node in tree.body if isinstance(node, ast.If) for inner in node.body)
    for node in [*tree.body, *guarded]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in trees)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in trees else node.module for name in inner if node.module in trees)


def folder_imports(trees: Trees) -> dict[str, set[str]]:
    """The same between folders. A module that lies directly in a package stands for itself."""
    imports: dict[str, set[str]] = {}
    for name, others in module_imports(trees).items():
        mine = _folder(name, trees)
        imports.setdefault(mine, set()).update(_folder(other, trees) for other in others)
        imports[mine].discard(mine)
    return imports


def _folder(name: str, trees: Trees) -> str:
    parts = name.split(".")
    return name if len(parts) <= 2 else ".".join(parts[:-1])


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Groups of two and more that import each other, directly or by others."""
    names = sorted(imports.keys() | {other for others in imports.values() for other in others})
    number = {name: i for i, name in enumerate(names)}
    pairs = [(number[a], number[b]) for a, others in imports.items() for b in others]
    rows, columns = np.array(pairs or np.empty((0, 2)), dtype=int).T
    graph = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), (len(names), len(names)))
    _, label = connected_components(graph, directed=True, connection="strong")
    members = [[name for name in names if label[number[name]] == k] for k in range(label.max(initial=-1) + 1)]
    return [group for group in members if len(group) > 1]


if __name__ == "__main__":
    main()
