# SPDX-License-Identifier: Apache-2.0
"""The reference of all parameters, ``docs/parameters.md``, made from the configuration classes themselves.

python -m slam_bringup.parameter_reference > docs/parameters.md
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from slam_bringup.pipeline.configuration import SystemConfig
from slam_core.config import Config, ParameterInfo, iterate_parameters
from slam_core.input_config import InputConfig

_PREAMBLE = """\
# Parameters

Made from the configuration classes by `python -m slam_bringup.parameter_reference`; do not edit. Every node declares
these as ROS parameters (`ros2 param describe` tells the same); `slam run --config FILE` and `slam nodes --config FILE`
take them as YAML:

```yaml
ekf_slam:
  ros__parameters:            # may be left out
    submap.max_distance: 1.5
```
"""


def reference() -> str:
    """The page as Markdown."""
    system = SystemConfig()
    sections = [_section(f.name, getattr(system, f.name)) for f in fields(system)]
    sections.append(_section("Every node (`--ros-args -p input.policy:=all`)", InputConfig(), "input."))
    return "\n".join([_PREAMBLE, *sections])


def _section(name: str, config: Config, prefix: str = "") -> str:
    rows = [_row(*entry) for entry in iterate_parameters(config, prefix)]
    return "\n".join([f"## {name}\n", "| parameter | default | range | meaning |", "|---|---|---|---|", *rows, ""])


def _row(name: str, value: Any, info: ParameterInfo) -> str:
    unit = f" {info.unit}" if info.unit else ""
    description = info.description.replace("|", "\\|")
    return f"| `{name}` | {_shown(value)}{unit} | {_range(info)} | {description} |"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) or '""'


def _range(info: ParameterInfo) -> str:
    if info.choices:
        return ", ".join(info.choices)
    bounds = [("≥", info.minimum), ("≤", info.maximum)]
    return " ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)


if __name__ == "__main__":
    print(reference(), end="")
