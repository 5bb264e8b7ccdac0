# SPDX-License-Identifier: Apache-2.0
"""The reference of all parameters, ``docs/parameters.md``, made from the configuration classes themselves.

python -m slam_bringup.parameter_reference > docs/parameters.md
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.node_table import NODES
from slam_core.config import Config, ParameterInfo, iterate_parameters
from slam_core.nodes.input_config import InputConfig

_PREAMBLE = """\
# Parameters

Made from the configuration classes by `python -m slam_bringup.parameter_reference`; do not edit. Every node declares
these as ROS parameters (`ros2 param describe` tells the same); `slam run --config FILE` and `slam nodes --config FILE`
take them as YAML. What begins with "node:" only the node has, and `slam run` passes over:

```yaml
ekf_slam:
  ros__parameters:            # may be left out
    submap.max_distance: 1.5
```
"""


def reference() -> str:
    """The page as Markdown; it needs ROS, whose nodes have parameters of their own."""
    system = {f.name: getattr(SystemConfig(), f.name) for f in fields(SystemConfig)}
    sections = [_node_section(d.executable, system.get(d.executable), d.load_config_class()()) for d in NODES]
    judged = [_row(*entry) for entry in iterate_parameters(system["run"])]
    sections.append(
        _section("run (no node: by this `slam run`, `slam nodes` and `slam demo` judge a finished run)", judged)
    )
    every = [_row(*entry) for entry in iterate_parameters(InputConfig(), "input.")]
    sections.append(_section("Every node (`--ros-args -p input.policy:=all`)", every))
    return "\n".join([_PREAMBLE, *sections])


def _node_section(name: str, algorithm: Config | None, node: Config) -> str:
    """The parameters of the algorithm, which ``slam run`` takes as well, then those that only the node has."""
    known = {} if algorithm is None else {n: (n, v, info) for n, v, info in iterate_parameters(algorithm)}
    own = [entry for entry in iterate_parameters(node) if entry[0] not in known]
    rows = [_row(*entry) for entry in known.values()] + [_row(*entry, "node: ") for entry in own]
    return _section(name, rows)


def _section(name: str, rows: list[str]) -> str:
    return "\n".join([f"## {name}\n", "| parameter | default | range | meaning |", "|---|---|---|---|", *rows, ""])


def _row(name: str, value: Any, info: ParameterInfo, kind: str = "") -> str:
    unit = f" {info.unit}" if info.unit else ""
    description = kind + info.description.replace("|", "\\|")
    return f"| `{name}` | {_shown(value)}{unit} | {_range(info)} | {description} |"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(str(part) or '""' for part in value) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value) or '""'


def _range(info: ParameterInfo) -> str:
    if info.choices:
        return ", ".join(info.choices)
    bounds = [("≥", info.minimum), ("≤", info.maximum)]
    return " ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)


if __name__ == "__main__":
    print(reference(), end="")
