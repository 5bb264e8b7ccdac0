# SPDX-License-Identifier: Apache-2.0
"""Typed configuration: one frozen dataclass per algorithm, the only place for names, defaults, ranges, descriptions.

    @dataclass(frozen=True)
    class NdtConfig(Config):
        voxel_size: float = parameter(0.5, "edge of a cell", unit="m", minimum=0.05)

Nodes declare their ROS parameters from it (``slam_core.ros.declare_config``), the command line and YAML files override
it (:func:`from_mapping`), and every value is checked when the object is made. A field whose type is itself a ``Config``
is a group: its parameters are named ``group.name``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

C = TypeVar("C", bound="Config")


@dataclass(frozen=True)
class ParameterInfo:
    """Description, unit and range of a parameter."""

    description: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()

    def text(self) -> str:
        """Description with unit and choices, as shown by ``ros2 param describe`` and the documentation."""
        parts = [self.description]
        if self.unit:
            parts.append(f"[{self.unit}]")
        if self.choices:
            parts.append("one of " + ", ".join(self.choices))
        return " ".join(parts)


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field that is a parameter. ``minimum`` and ``maximum`` are inclusive."""
    return field(default=default, metadata={"parameter": ParameterInfo(description, unit, minimum, maximum, choices)})


def group(config_type: type[C]) -> Any:
    """A dataclass field that is itself a configuration with all its defaults."""
    return field(default_factory=config_type)


@dataclass(frozen=True)
class Config:
    """Base of every configuration: checks each parameter's type and range when an object is made."""

    def __post_init__(self) -> None:
        types = typing.get_type_hints(type(self))
        for f in dataclasses.fields(self):
            info = f.metadata.get("parameter")
            if info is not None:
                value = _checked(f.name, getattr(self, f.name), types[f.name], info)
                object.__setattr__(self, f.name, value)


def _checked(name: str, value: Any, kind: Any, info: ParameterInfo) -> Any:
    unit = f" {info.unit}" if info.unit else ""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    origin = typing.get_origin(kind) or kind
    if origin is tuple and isinstance(value, list):
        value = tuple(value)
    if origin is tuple and typing.get_args(kind)[:1] == (float,):
        value = tuple(_finite_number(name, v, unit) for v in value)
    if not isinstance(value, origin) or (origin in (int, float) and isinstance(value, bool)):
        raise ValueError(f"parameter '{name}' must be {getattr(kind, '__name__', kind)}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"parameter '{name}' must be finite, got {value}{unit}")
    if info.minimum is not None and value < info.minimum:
        raise ValueError(f"parameter '{name}' must be at least {info.minimum}{unit}, got {value}{unit}")
    if info.maximum is not None and value > info.maximum:
        raise ValueError(f"parameter '{name}' must be at most {info.maximum}{unit}, got {value}{unit}")
    if info.choices and value not in info.choices:
        raise ValueError(f"parameter '{name}' must be one of {', '.join(info.choices)}, got {value!r}")
    return value


def _finite_number(name: str, value: Any, unit: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"parameter '{name}' must hold finite numbers, got {value!r}{unit}")
    return float(value)


def iterate_parameters(config: Config, prefix: str = "") -> Iterator[tuple[str, Any, ParameterInfo]]:
    """Every parameter as (dotted name, value, info), groups flattened, in the order of declaration."""
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        info = f.metadata.get("parameter")
        if info is not None:
            yield prefix + f.name, value, info
        elif isinstance(value, Config):
            yield from iterate_parameters(value, f"{prefix}{f.name}.")


def from_mapping(config_type: type[C], values: Mapping[str, Any]) -> C:
    """The default configuration with some values replaced; keys may be nested mappings or dotted names.

    Raises
    ------
    ValueError
        For an unknown name (with the nearest known one), a wrong type or a value out of range.
    """
    return changed(config_type(), values)


def changed(config: C, values: Mapping[str, Any], prefix: str = "") -> C:
    """A configuration with some values replaced, as :func:`from_mapping`; what is not named stays as it is.

    ``prefix``: what stands before the names where a user writes them, for messages.
    """
    known = {f.name: (getattr(config, f.name), f.metadata.get("parameter")) for f in dataclasses.fields(config)}
    types = typing.get_type_hints(type(config))
    replaced: dict[str, Any] = {}
    for name, value in _nested(values).items():
        if not (name in known and _can_be_set(config, name)):
            raise ValueError(_unknown(config, name, prefix))
        current, info = known[name]
        if info is not None:
            value = _checked(prefix + name, value, types[name], info)
        else:
            if not isinstance(value, Mapping):
                raise ValueError(f"parameter group '{prefix}{name}' needs a mapping, got {value!r}")
            value = changed(current, value, f"{prefix}{name}.")
        replaced[name] = value
    return dataclasses.replace(config, **replaced)


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names as mappings of their groups."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        head, _, rest = key.partition(".")
        if rest:
            nested.setdefault(head, {})[rest] = value
        elif isinstance(value, Mapping):
            nested.setdefault(head, {}).update(value)
        else:
            nested[head] = value
    return nested


def _can_be_set(config: Config, name: str) -> bool:
    """True if a field is a parameter or a group of such."""
    info = {f.name: f.metadata for f in dataclasses.fields(config)}[name]
    return "parameter" in info or isinstance(getattr(config, name), Config)


def _unknown(config: Config, name: str, prefix: str) -> str:
    known = [f.name for f in dataclasses.fields(config) if _can_be_set(config, f.name)]
    near = difflib.get_close_matches(name, known, 1)
    hint = (
        f"; did you mean '{prefix}{near[0]}'?" if near else f"; known: {', '.join(prefix + n for n in sorted(known))}"
    )
    return f"unknown parameter '{prefix}{name}'{hint}"
