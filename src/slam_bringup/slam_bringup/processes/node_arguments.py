# SPDX-License-Identifier: Apache-2.0
"""Command-line arguments that set a node's parameters, namespace and name, as ``ros2 run`` takes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def ros_arguments(parameters: Mapping[str, Any], namespace: str = "") -> list[str]:
    """``["--ros-args", "-p", "rate:=2.0", ...]``; empty sequences are left out, being the default."""
    arguments = ["--ros-args"]
    if namespace:
        arguments += ["-r", f"__ns:=/{namespace.strip('/')}"]
    for name, value in parameters.items():
        if not (isinstance(value, tuple | list) and not value):
            arguments += ["-p", f"{name}:={_yaml(value)}"]
    return arguments


def _yaml(value: Any) -> str:
    """A value as YAML in one line: JSON is a subset of it."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)
