# SPDX-License-Identifier: Apache-2.0
"""The estimate has one writer, its arrays one package, and what is refused leaves no trace."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap
from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing.state import EstimateState

SRC = Path(__file__).resolve().parents[2] / "src"
OWNERS = [SRC / "sjsam_node/sjsam_node" / folder for folder in ("graph", "smoothing")]
STATE, FACTS = ({f.name for f in fields(kind)} for kind in (EstimateState, MapGraph))
ARRAYS = {
    *("poses", "points", "component_of", "overconfidence", "redundant", "last_needed", "starts", "ends", "ending_at"),
    *("landmark_of", "record_of", "variable_of", "is_connecting", "point_covariances", "budgets", "odometry", "sets"),
}
FILES = [p for p in SRC.rglob("*.py") if p.name != "setup.py"]


def names_of_maps(tree: ast.AST) -> set[str]:
    """The names by which a module calls a graph or a state: the usual ones, and arguments declared as such."""
    arguments = (node for node in ast.walk(tree) if isinstance(node, ast.arg) and node.annotation is not None)
    declared = {a.arg for a in arguments if ast.unparse(a.annotation) in ("MapGraph", "EstimateState")}
    return {"graph", "state", "_state", *declared}


def is_map(node: ast.expr, names: set[str]) -> bool:
    """Whether an expression names a graph or a state: by its own name or its last attribute."""
    name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    return name in names


def assignments(tree: ast.AST) -> Iterator[ast.Attribute]:
    """Yield the attributes that statements assign to, wholly or in part."""
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign) else []:
            while isinstance(target, ast.Subscript):
                target = target.value
            if isinstance(target, ast.Attribute):
                yield target


def writes(tree: ast.AST) -> list[str]:
    """Assignments to the state that holds, and to anything in a graph or a state."""
    names = names_of_maps(tree)
    return [
        ast.unparse(target)
        for target in assignments(tree)
        if target.attr == "_state" or (is_map(target.value, names) and target.attr in STATE | FACTS)
    ]


def accesses(tree: ast.AST) -> list[str]:
    """Accesses to the arrays of a graph or a state."""
    names = names_of_maps(tree)
    found = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))
    return [ast.unparse(node) for node in found if node.attr in ARRAYS and is_map(node.value, names)]


def map_files() -> list[Path]:
    """Files that import the map's package, but for those with graphs in the plane."""
    return [p for p in FILES if "sjsam_node" in p.read_text(encoding="utf-8") and "planar" not in p.parts]


def test_the_estimate_alone_says_which_state_holds() -> None:
    inside = [p for p in map_files() if "slam_bringup" not in str(p)]  # which has states of other things
    found = {p.name: writes(ast.parse(p.read_text(encoding="utf-8"))) for p in inside}
    assert set(found.pop("estimate.py")) == {"self._state"}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_nobody_outside_its_package_touches_the_arrays_of_the_map() -> None:
    outside = [p for p in map_files() if p.parent not in OWNERS]
    found = {p.name: accesses(ast.parse(p.read_text(encoding="utf-8"))) for p in outside}
    assert {name: lines for name, lines in found.items() if lines} == {}


@pytest.mark.parametrize(
    "code",
    ["self._state = s", "state.poses[0] = 1", "self.map.graph.links = []", "graph.points += 1", "state.a.b[0] = 1"],
)
def test_a_write_is_found(code: str) -> None:
    assert writes(ast.parse(code)) == ([] if ".a." in code else [code.split("[0]")[0].split(" ")[0]])


def test_an_access_is_found() -> None:
    assert accesses(ast.parse("x = result.global_map.graph.poses[0]")) == ["result.global_map.graph.poses"]
    assert accesses(ast.parse("def f(one: MapGraph): return one.starts")) == ["one.starts"]


def test_the_arrays_of_a_state_cannot_be_written_to(rng: np.random.Generator) -> None:
    state = join(Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "a").submaps())[0].state
    assert is_dataclass(state)
    for array in state.arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


def every_byte(value: object) -> object:
    """All that a state holds, arrays as bytes, down to the facts and condensed submaps; what was solved by identity."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, tuple | list):
        return [every_byte(item) for item in value]
    if isinstance(value, dict):
        return {key: id(item) for key, item in value.items()}
    if is_dataclass(value) and type(value).__module__.startswith("sjsam_node."):
        return {f.name: every_byte(getattr(value, f.name)) for f in fields(value) if f.name != "submap"}
    return repr(value)


def test_a_refused_closure_leaves_every_byte_as_it_was(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.9), rng, "a")
    joined, _ = join(agent.submaps())
    newest = len(joined.snapshot()) - 1
    T = np.eye(4)
    T[:3, 3] = (0.5, 0.2, 0.0)  # within the drift to expect, so that it is tried; but not where the landmarks are
    pairs = np.stack([np.arange(12), np.arange(12)], axis=1)
    false = Link(2, newest, pairs, T, 1e-4 * np.eye(6), is_closure=True)
    tried: list[EstimateState] = []
    accepts = type(joined.closures.map_test).accepts

    def watched(test: object, before: EstimateState, after: EstimateState, *rest: object) -> bool:
        tried.append(after)
        return bool(accepts(test, before, after, *rest))

    monkeypatch.setattr(type(joined.closures.map_test), "accepts", watched)
    state, bytes_before = joined.state, every_byte(joined.state)
    assert joined.closures._tried([false], [], newest) is None
    assert tried
    assert tried[0] is not state
    assert len(tried[0].graph.records) == len(state.graph.records)
    assert joined.state is state
    assert every_byte(joined.state) == bytes_before
    assert every_byte(tried[0]) != bytes_before


def test_facts_are_values(rng: np.random.Generator) -> None:
    submaps = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "a").submaps()
    graph = MapGraph().with_submap(submaps[0], None)
    more = graph.with_submap(submaps[1], graph.records[0].end)
    assert (len(graph.records), len(more.records)) == (1, 2)
    linked = more.with_links([Link(0, 1, np.array([[0, 0]]), np.eye(4), np.eye(6))])
    assert more.links == ()
    assert not more.sets.is_shared.any()
    assert linked.sets.is_shared.sum() == 2
    assert isinstance(GlobalMap().snapshot().poses, np.ndarray)
