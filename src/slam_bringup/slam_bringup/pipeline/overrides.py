# SPDX-License-Identifier: Apache-2.0
"""Parameters from a YAML file, by node: groups named after the nodes, or ROS's own form with names of nodes.

    /**:                        every node that has the parameter
      ros__parameters:
        input.depth: 20
    ekf_slam:                   the node of that name, of every agent; the level ros__parameters may be left out
      submap: {max_distance: 1.5}
    /one/ekf_slam:              the node of one agent
      ros__parameters:
        submap.max_distance: 2.0

What stands further down, and what names a node rather than all, goes before what does not.
"""

from __future__ import annotations

import difflib
import importlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from slam_bringup.pipeline.node_table import is_node, node_named
from slam_core.config import Config, iterate_parameters
from slam_core.storage.files import read_yaml

_BASE_CONFIG = ("slam_core.nodes.listening_node", "InputConfig", "input.")
_EVERY_NODE = "/**"
_ROS_LEVEL = "ros__parameters"
_ROS_OWN = ("use_sim_time", "qos_overrides.", "start_type_description_service")


@dataclass(frozen=True)
class Overrides:
    """Rules in the order of their precedence, the last one first asked: a name or pattern of nodes, and values."""

    origin: str = ""
    rules: tuple[tuple[str, dict[str, Any]], ...] = ()

    def of(self, full_name: str) -> dict[str, Any]:
        """Values by dotted name for a node like ``/one/ekf_slam``, without those that stand under ``/**``."""
        found: dict[str, Any] = {}
        for pattern, values in self.rules:
            if pattern != _EVERY_NODE and _names(pattern, full_name):
                found |= values
        return found

    @property
    def of_all(self) -> dict[str, Any]:
        """Values for every node that has such a parameter."""
        return {
            name: value for pattern, values in self.rules if pattern == _EVERY_NODE for name, value in values.items()
        }

    def with_values(self, content: Mapping[Any, Any], origin: str) -> Overrides:
        """All rules, those of a mapping last."""
        return Overrides(self.origin, (*self.rules, *overrides_of(content, origin).rules))


def read_overrides(path: Path) -> Overrides:
    """The rules of a YAML file.

    Raises
    ------
    ValueError
        If the file is no mapping of nodes to parameters, or names a node that there is not.
    """
    content = read_yaml(path) or {}
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} must hold one mapping per node, found {type(content).__name__}")
    return overrides_of(content, str(path))


def overrides_of(content: Mapping[Any, Any], origin: str) -> Overrides:
    """The rules of a mapping; ``origin`` is named where something is wrong."""
    rules = [(str(name), _values(origin, str(name), values)) for name, values in content.items()]
    return Overrides(origin, tuple(sorted(rules, key=lambda rule: rule[0] != _EVERY_NODE)))


def require_known_nodes(overrides: Overrides, known: set[str]) -> None:
    """Refuse rules for nodes that there are not; a rule with a pattern in its last part may be for any."""
    for pattern, _ in overrides.rules:
        node = pattern.rsplit("/", 1)[-1]
        if "*" not in node and node not in known:
            near = difflib.get_close_matches(node, known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(known))}"
            raise ValueError(f"{overrides.origin}: no node '{node}' ({hint}); it must hold one mapping per node")


def require_known_parameters(overrides: Overrides, node: str) -> None:
    """Refuse rules for a node with a name that it does not have, where its names can be known (ROS is installed)."""
    wanted = overrides.of(f"/{node}")
    known = _parameters_of(node) if wanted else frozenset()  # ROS takes a quarter of a second to load
    for name in wanted if known else ():
        if not is_parameter_of(node, name):
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(f"{overrides.origin}: {node}: unknown parameter '{name}'{hint}")


def parse_assignments(text: str) -> dict[str, dict[str, Any]]:
    """Parameters by node, of a text like ``ekf_slam.submap.max_distance=1.5, stereo_driver.compressed=true``."""
    found: dict[str, dict[str, Any]] = {}
    for part in filter(None, (p.strip() for p in re.split(r"[;,](?![^\[]*\])", text))):
        target, is_assigned, value = part.partition("=")
        node, is_named, name = target.strip().partition(".")
        if not (is_assigned and is_named):
            raise ValueError(f"'{part}' is not NODE.PARAMETER=VALUE")
        found.setdefault(node, {})[name] = yaml.safe_load(value)
    return found


def is_parameter_of(node: str, name: str) -> bool:
    """True if a node has a parameter; False as well where ROS, and with it the nodes, is not installed."""
    return name.startswith(_ROS_OWN) or name in _parameters_of(node)


@cache
def _parameters_of(node: str) -> frozenset[str]:
    if not is_node(node):
        return frozenset()
    module, name, prefix = _BASE_CONFIG
    try:
        own = node_named(node).load_config_class()
        base = getattr(importlib.import_module(module), name)
    except ImportError:
        return frozenset()
    return frozenset([*_dotted_names(own()), *(prefix + p for p in _dotted_names(base()))])


def _dotted_names(config: Config) -> Iterator[str]:
    return (name for name, _, _ in iterate_parameters(config))


def _values(origin: str, node: str, values: Any) -> dict[str, Any]:
    values = {} if values is None else values
    if isinstance(values, Mapping):
        values = values.get(_ROS_LEVEL, values)
    if not isinstance(values, Mapping):
        raise ValueError(f"{origin}: the parameters of {node} must be a mapping, found {values!r}")
    return dict(_flattened(values))


def _flattened(values: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _names(pattern: str, full_name: str) -> bool:
    """True if a rule is for a node: a bare name in any namespace; ``*`` one part of a name, ``**`` any number."""
    if not pattern.startswith("/"):
        pattern = f"/**/{pattern}"
    parts = {"/**/": "/(?:.*/)?", "/**": "(?:/.*)?", "**": ".*", "*": "[^/]*"}
    expression = re.sub(r"/\*\*/|/\*\*|\*\*|\*|[^*/]+|/", lambda m: parts.get(m[0], re.escape(m[0])), pattern)
    return re.fullmatch(expression, full_name) is not None
