# SPDX-License-Identifier: Apache-2.0
"""Every declared ROS parameter, node by node, and where it is varied.

    python benchmarks/house/parameters.py [CHECKOUT] [--varied-by KIND | --by-none]

A parameter is varied where a file gives it a value: a configuration made or changed in Python, a line of YAML, an
option in a page. Read from the syntax trees and texts alone; nothing is imported.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NODES = {
    "stereo_driver": "StereoDriverConfig",
    "tof_driver": "TofDriverConfig",
    "feature_extractor": "FrontendConfig",
    "ndt_odometry": "NdtNodeConfig",
    "ekf_slam": "EkfNodeConfig",
    "sjsam": "SjsamNodeConfig",
    "dense_mapper": "DenseNodeConfig",
    "viewer": "ViewerConfig",
    "bag_player": "PlayerConfig",
    "recorder": "RecorderConfig",
    "every node": "InputConfig",
}
"""Configuration class of each node."""
KINDS = {
    "launch": ("src/*/launch/**/*", "src/*/config/**/*", "src/slam_bringup/slam_bringup/processes/*.py"),
    "code": ("src/**/*.py",),
    "experiments": ("src/slam_experiments/**/*.py", "bags/**/*"),
    "docs": ("docs/**/*.md", "README.md", "bags/README.md"),
    "benchmarks": ("benchmarks/**/*",),
    "tests": ("test/**/*.py",),
}
"""Where to look. A file counts for the first kind that names it; ``code`` is looked at last."""
_GENERATED = ("docs/parameters.md",)
_TEXT = {".py", ".md", ".yaml", ".yml"}


@dataclass
class ConfigClass:
    """A configuration in the syntax tree: its own parameters, groups (field to class) and base classes."""

    name: str
    module: str
    bases: list[str]
    parameters: list[str] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Declared:
    """One parameter of one node by its dotted name, and the class and field that declare it."""

    node: str
    name: str
    config: str
    field: str


def main() -> None:
    """Print a row per parameter and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", nargs="?", type=Path, default=ROOT)
    parser.add_argument("--varied-by", choices=KINDS, help="only those varied by this kind of file")
    parser.add_argument("--by-none", action="store_true", help="only those that nothing varies")
    arguments = parser.parse_args()
    parameters = declared_parameters(arguments.checkout)
    varied = Variations(arguments.checkout)
    print("| node | parameter | varied by |\n|---|---|---|")
    never = 0
    for p in parameters:
        by = varied.of(p)
        never += not by
        if (arguments.varied_by and arguments.varied_by not in by) or (arguments.by_none and by):
            continue
        print(f"| {p.node} | `{p.name}` | {', '.join(by) or '-'} |")
    distinct = {(p.config, p.field) for p in parameters}
    per_node = ", ".join(f"{node} {count}" for node, count in Counter(p.node for p in parameters).items())
    print(f"\n{len(parameters)} declared ({per_node}), {len(distinct)} distinct; {never} that nothing varies")


# ---- declared
def declared_parameters(checkout: Path) -> list[Declared]:
    """Parameters of all nodes, in the order of declaration, groups flattened."""
    classes = config_classes(checkout)
    found = []
    for node, root in NODES.items():
        if root in classes:
            prefix = "input." if node == "every node" else ""
            found += [Declared(node, prefix + name, *owner) for name, owner in _flattened(classes, classes[root])]
    return found


def config_classes(checkout: Path) -> dict[str, ConfigClass]:
    """All classes below ``src`` by name, and by ``folder:name`` where a name stands twice."""
    classes: dict[str, ConfigClass] = {}
    for path in sorted((checkout / "src").rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                found = _config_class(node, path)
                classes[f"{path.parent}:{found.name}"] = found
                classes[found.name] = found
    return classes


def _config_class(node: ast.ClassDef, path: Path) -> ConfigClass:
    found = ConfigClass(node.name, str(path.parent), [b.id for b in node.bases if isinstance(b, ast.Name)])
    for item in node.body:
        call = item.value if isinstance(item, ast.AnnAssign) else None
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and isinstance(item.target, ast.Name)):
            continue
        if call.func.id == "parameter":
            found.parameters.append(item.target.id)
        elif isinstance(item.annotation, ast.Name) and call.func.id in ("group", "field"):
            found.groups[item.target.id] = item.annotation.id
    return found


def _flattened(
    classes: dict[str, ConfigClass], config: ConfigClass, prefix: str = ""
) -> Iterator[tuple[str, tuple[str, str]]]:
    for base in config.bases:
        if base in classes:
            yield from _flattened(classes, _resolved(classes, base, config), prefix)
    for name in config.parameters:
        yield prefix + name, (config.name, name)
    for name, kind in config.groups.items():
        if kind in classes:
            yield from _flattened(classes, _resolved(classes, kind, config), f"{prefix}{name}.")


def _resolved(classes: dict[str, ConfigClass], name: str, user: ConfigClass) -> ConfigClass:
    return classes.get(f"{user.module}:{name}", classes[name])


# ---- varied
class Variations:
    """Places that give a parameter a value, by kind of file."""

    def __init__(self, checkout: Path) -> None:
        self._keywords: dict[str, set[tuple[str, str]]] = {kind: set() for kind in KINDS}
        self._texts: dict[str, str] = {}
        seen: set[Path] = {checkout / name for name in _GENERATED}
        for kind in [*(k for k in KINDS if k != "code"), "code"]:
            texts = []
            for path in _files(checkout, KINDS[kind]):
                if path in seen:
                    continue
                seen.add(path)
                text = path.read_text(encoding="utf-8")
                texts.append(text)
                if path.suffix == ".py":
                    self._keywords[kind] |= set(_keywords(ast.parse(text)))
            self._texts[kind] = "\n".join(texts)

    def of(self, p: Declared) -> list[str]:
        """Kinds of files that vary a parameter."""
        return [kind for kind in KINDS if self._by_keyword(kind, p) or self._by_text(kind, p)]

    def _by_keyword(self, kind: str, p: Declared) -> bool:
        return bool({(p.config, p.field), ("replace", p.field)} & self._keywords[kind])

    def _by_text(self, kind: str, p: Declared) -> bool:
        """Dotted names stand for themselves, short ones only with a value or as a name in a page."""
        if "." in p.name:
            *_, group, name = p.name.split(".")
            dotted = re.escape(f"{group}.{name}")
            # group.name, or the mapping {group: {..., name: ...}} of YAML and Python
            nested = rf"\b{re.escape(group)}[\"']?: *\{{[^{{}}]*\b{re.escape(name)}[\"']?:"
            return re.search(rf"\b{dotted}(?:[\"'`:=]|\b *:)|{nested}", self._texts[kind]) is not None
        name = re.escape(p.name)
        patterns = [rf"{p.node}\.{name}\b", rf"-p {name}:=", rf"{p.node}[\"']?: *\{{[^{{}}]*\b{name}[\"']?:"]
        patterns.append(rf"`{name}(?::=|`)" if kind == "docs" else rf"{name}:=")
        if kind == "launch":
            patterns.append(rf"[\"']{name}[\"']")
        return any(re.search(pattern, self._texts[kind]) for pattern in patterns)


def _files(checkout: Path, patterns: tuple[str, ...]) -> Iterator[Path]:
    for pattern in patterns:
        yield from (p for p in sorted(checkout.glob(pattern)) if p.is_file() and p.suffix in _TEXT)


def _keywords(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Keyword arguments of calls, as (function, keyword)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            yield from ((name, keyword.arg) for keyword in node.keywords if keyword.arg)


if __name__ == "__main__":
    main()
