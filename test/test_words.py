# SPDX-License-Identifier: Apache-2.0
"""Names in the code are the field's terms: words of our own, once replaced, do not come back."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

SRC = Path(__file__).resolve().parent.parent / "src"
FILES = sorted(SRC.rglob("*.py"))
REPLACED = {
    "Sight": "LandmarkMatches",
    "Pending": "CandidateLandmarks",
    "inheriting": "with_inherited_ids",
    "tidy": "prune_landmarks",
    "confirm": "initialise_landmarks",
    "Aid": "RelativePoseMeasurement",
    "MotionAids": "RelativePoseBuffer",
    "refute": "is_inconsistent",
    "excess": "variance_scale",
    "CommonError": "CorrelatedNoise",
    "explaining_sigma": "inflated_process_noise",
    "aided": "aided",
    "doubt": "add_inconsistency, overconfidence",
    "strain": "reduced_chi2",
    "relieve": "resolve_overconfidence",
    "_let_go": "remove_conflicting",
    "Parked": "FrozenSubmap",
    "Region": "CondensedSubmap",
    "carry": "apply_motion",
    "holds": "is_valid, contains",
    "pull": "gradient",
    "_hung": "dependent_covariance",
    "tie_by": "landmark budget",
    "way": "path_length",
    "Fusion": "LandmarkSets",
    "Novelty": "RedundancyCheck",
    "centrally": "rebuilt_in_time_order",
    "MapGrowth": "MapSession",
    "Joining": "MapSession",
    "Locating": "MapSession",
    "_stand": "_zero_velocity_update",
    "_coast": "dead_reckon",
    "_miss": "track_lost",
    "_cross": "_restart_after_gap",
    "put_away": "retire, page_out",
    "ahead": "prefetch",
    "told": "describe_error",
    "complaint": "diagnostic",
    "_MEMORY": "what it counts",
    "_ENOUGH": "what it counts",
}
"""A word of our own, and the term that stands for it."""


def defined(tree: ast.AST) -> Iterator[str]:
    """Names of classes, functions, fields and constants."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id
        elif isinstance(node, ast.Module | ast.ClassDef):
            for part in node.body:
                if isinstance(part, ast.Assign):
                    names = (name for target in part.targets for name in ast.walk(target))
                    yield from (name.id for name in names if isinstance(name, ast.Name))


def test_no_name_is_a_word_that_was_replaced():
    found = [
        f"{path.relative_to(SRC)}: {name} (say {REPLACED[name]})"
        for path in FILES
        for name in defined(ast.parse(path.read_text(encoding="utf-8")))
        if name in REPLACED
    ]
    assert found == []


def test_constants_say_what_they_count():
    vague = re.compile(r"_?(MEMORY|ENOUGH|FEW|MANY|LIMIT|NUMBER)")
    assert [
        f"{path.relative_to(SRC)}: {name}"
        for path in FILES
        for name in defined(ast.parse(path.read_text(encoding="utf-8")))
        if vague.fullmatch(name)
    ] == []
