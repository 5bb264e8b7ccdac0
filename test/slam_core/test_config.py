# SPDX-License-Identifier: Apache-2.0
"""Typed configuration: defaults, ranges, groups, and errors that help."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from slam_core.config import Config, from_mapping, group, iterate_parameters, parameter


@dataclass(frozen=True)
class Inner(Config):
    voxel_size: float = parameter(0.5, "edge of a cell", unit="m", minimum=0.05, maximum=10.0)
    method: str = parameter("ndt", "algorithm", choices=("ndt", "icp"))


@dataclass(frozen=True)
class Outer(Config):
    enabled: bool = parameter(True, "switch")
    iterations: int = parameter(10, "number of iterations", minimum=1)
    scales: tuple[float, ...] = parameter((2.0, 1.0), "scales")
    inner: Inner = group(Inner)


def test_nested_and_dotted_names_are_the_same() -> None:
    nested = from_mapping(Outer, {"inner": {"voxel_size": 1}, "iterations": 3})
    dotted = from_mapping(Outer, {"inner.voxel_size": 1.0, "iterations": 3})
    assert nested == dotted
    assert nested.inner.voxel_size == 1.0
    assert isinstance(nested.inner.voxel_size, float)


def test_all_parameters_are_listed_in_order_with_their_text() -> None:
    listed = {name: (value, info.text()) for name, value, info in iterate_parameters(Outer())}
    assert list(listed) == ["enabled", "iterations", "scales", "inner.voxel_size", "inner.method"]
    assert listed["inner.voxel_size"] == (0.5, "edge of a cell [m]")
    assert listed["inner.method"][1] == "algorithm one of ndt, icp"


def test_the_listed_values_rebuild_the_configuration() -> None:
    config = from_mapping(Outer, {"inner.method": "icp", "scales": [4, 2]})
    assert from_mapping(Outer, {name: value for name, value, _ in iterate_parameters(config)}) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"iteration": 3}, "did you mean 'iterations'"),
        ({"inner.voxel": 3}, "voxel_size"),
        ({"iterations": 0}, "at least 1"),
        ({"iterations": 2.5}, "must be int"),
        ({"iterations": True}, "must be int"),
        ({"enabled": 1}, "must be bool"),
        ({"inner.voxel_size": 11.0}, "at most 10.0 m"),
        ({"inner.voxel_size": float("nan")}, "finite"),
        ({"inner.voxel_size": "big"}, "voxel_size"),
        ({"inner.method": "gicp"}, "one of ndt, icp"),
        ({"inner": 3}, "needs a mapping"),
        ({"scales": ["a"]}, "scales"),
        ({"scales": [1.0, float("inf")]}, "scales"),
    ],
)
def test_bad_values_are_refused_by_name(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_mapping(Outer, values)


def test_dotted_name_and_nested_mapping_of_one_group_add_up() -> None:
    config = from_mapping(Outer, {"inner": {"voxel_size": 2.0}, "inner.method": "icp"})
    assert (config.inner.voxel_size, config.inner.method) == (2.0, "icp")
