# SPDX-License-Identifier: Apache-2.0
"""Mutation score of the estimators' tests: a sample of small faults, and how many of them the tests see.

    pip install cosmic-ray
    python benchmarks/house/mutation.py [PACKAGE ...] [--mutants 12] [--seed 1] [--json FILE]

Each mutant is one change that Cosmic Ray makes of an operator, comparison, number or loop, outside of annotations and
of the declarations of parameters, in a copy of this checkout. Only the package's own tests are run, those of the
mutated module first, until one fails. A mutant that survives may be equivalent to the original: each is printed.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.provider import OperatorProvider

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("slam_core", "ekf_slam_node", "ndt_registration", "stereo_frontend", "sjsam_node")
KINDS = {
    "sums": ("ReplaceBinaryOperator_Add_Sub", "ReplaceBinaryOperator_Sub_Add"),
    "products": ("ReplaceBinaryOperator_Mul_Div", "ReplaceBinaryOperator_Div_Mul"),
    "comparisons": tuple(
        f"ReplaceComparisonOperator_{a}_{b}"
        for a, b in (("Lt", "Gt"), ("Gt", "Lt"), ("LtE", "GtE"), ("GtE", "LtE"), ("Eq", "NotEq"), ("NotEq", "Eq"))
    ),
    "conditions": ("AddNot", "ReplaceAndWithOr", "ReplaceOrWithAnd"),
    "numbers": ("NumberReplacer", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue"),
    "loops": ("ZeroIterationForLoop", "ReplaceContinueWithBreak", "ReplaceBreakWithContinue"),
}
"""Cosmic Ray's operators, in kinds of which each gives as many mutants."""
NOT_ESTIMATORS = ("node.py", "__init__.py", "_node.py")
TIMEOUT_S = 900
Trees = dict[Path, list[Any]]


@dataclass(frozen=True)
class Mutant:
    """One change of one module: its line, the line before and after, and whether the tests saw it."""

    module: str
    line: int
    before: str
    after: str
    killed: bool


def main() -> None:
    """Print the score of each package and what survived."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", default=PACKAGES)
    parser.add_argument("--mutants", type=int, default=12, help="of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: dict[str, list[Mutant]] = {}
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder) / "checkout")
        for package in arguments.packages:
            rng = np.random.default_rng([arguments.seed, PACKAGES.index(package)])
            found[package] = []
            for path, changed in sample(copy / "src" / package / package, arguments.mutants, rng):
                mutant = judged(copy, package, path, changed)
                found[package].append(mutant)
                print("killed  " if mutant.killed else "SURVIVED", f"{mutant.module}:{mutant.line}", mutant.before,
                      "->", mutant.after, flush=True)  # fmt: skip
    print("\n| package | mutants | killed |\n|---|---|---|")
    for package, mutants in found.items():
        killed = sum(mutant.killed for mutant in mutants)
        print(f"| `{package}` | {len(mutants)} | {killed} ({100 * killed / len(mutants):.0f} %) |")
    if arguments.json is not None:
        values = {package: [asdict(mutant) for mutant in mutants] for package, mutants in found.items()}
        arguments.json.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def copied(folder: Path) -> Path:
    """A copy of this checkout's tracked and new files."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True)
    for name in listed.stdout.decode().splitlines():
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def sample(package: Path, count: int, rng: np.random.Generator) -> Iterator[tuple[Path, str]]:
    """Modules and mutated texts, no two alike, of every kind in turn."""
    modules = [path for path in sorted(package.rglob("*.py")) if not path.name.endswith(NOT_ESTIMATORS)]
    trees = {path: list(ast_nodes(get_ast(path.read_text(encoding="utf-8")))) for path in modules}
    waiting = {kind: iter(rng.permutation(np.array(places(trees, names), object))) for kind, names in KINDS.items()}
    texts: set[str] = set()
    for kind in cycle(KINDS):
        for path, name, occurrence in waiting[kind]:
            original = path.read_text(encoding="utf-8")
            changed = mutate_code(original, OperatorProvider()[name](), occurrence)
            if changed is not None and changed not in texts and meaning(changed) not in (None, meaning(original)):
                texts.add(changed)
                yield path, changed
                break
        if len(texts) == count:
            return


def places(trees: Trees, names: tuple[str, ...]) -> list[tuple[Path, str, int]]:
    """Every module, operator and occurrence of it."""
    found = []
    for name in names:
        operator = OperatorProvider()[name]()
        for path, nodes in trees.items():
            number = sum(len(list(operator.mutation_positions(node))) for node in nodes)
            found += [(path, name, k) for k in range(number)]
    return found


def meaning(text: str) -> str | None:
    """What of a module's text is executed: without docstrings, annotations and parameters; None if it is no Python."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
            node.decorator_list = []
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.ClassDef):
            node.body = [n for n in node.body if not isinstance(n, ast.AnnAssign | ast.Expr)] or [ast.Pass()]
    return ast.dump(tree)


def judged(copy: Path, package: str, path: Path, changed: str) -> Mutant:
    """Run the package's tests on a mutant; the module is restored."""
    original = path.read_text(encoding="utf-8")
    path.write_text(changed, encoding="utf-8")
    try:
        killed = not tests_pass(copy, package, path, has_kernels="njit" in original)
    finally:
        path.write_text(original, encoding="utf-8")
    lines = original.splitlines(), changed.splitlines()
    number = next((k for k, (a, b) in enumerate(zip(*lines, strict=False)) if a != b), 0)
    removed = [line[2:].strip() for line in difflib.ndiff(*lines) if line.startswith("- ")]
    added = [line[2:].strip() for line in difflib.ndiff(*lines) if line.startswith("+ ")]
    module = path.relative_to(copy / "src" / package).with_suffix("").as_posix().replace("/", ".")
    return Mutant(module, number + 1, " ".join(removed), " ".join(added), killed)


def tests_pass(copy: Path, package: str, path: Path, *, has_kernels: bool) -> bool:
    """Whether the package's tests pass; those named after the module come first. A mutant that hangs is seen."""
    tests = sorted((copy / "test" / package).rglob("test_*.py"), key=lambda t: (path.stem not in t.stem, t))
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join(str(p) for p in sorted((copy / "src").iterdir())))
    with tempfile.TemporaryDirectory() as kernels:
        if has_kernels:  # compiled callers in other modules would keep the kernel as it was
            environment["NUMBA_CACHE_DIR"] = kernels
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow and not ros", "-p", "no:cacheprovider",
                   *(str(t) for t in tests)]  # fmt: skip
        try:
            return (
                subprocess.run(
                    command, cwd=copy, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False
                ).returncode
                == 0
            )
        except subprocess.TimeoutExpired:
            return False


if __name__ == "__main__":
    main()
