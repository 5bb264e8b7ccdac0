# SPDX-License-Identifier: Apache-2.0
"""Messages of bags: rosbags classes with defaults and numpy fields, behind the :class:`MessageTypes` of slam_core."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from slam_core.messages import MessageTypes
from slam_core.types import AnyArray

_TEXT = ("string", "wstring")


@cache
def typestore() -> Typestore:
    """The message definitions of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


class BagTypes(MessageTypes):
    """Makes rosbags messages; fields that are not given get ROS's defaults (zero, empty, identity quaternion)."""

    def load(self, package: str, name: str) -> Callable[..., Any]:
        """Constructor of ``package/msg/name``."""
        return partial(_make, f"{package}/msg/{name}")

    def octets(self, array: AnyArray) -> Any:
        """A flat uint8 view of the array."""
        return np.ascontiguousarray(array).reshape(-1).view(np.uint8)

    def signed_octets(self, array: AnyArray) -> Any:
        """A flat int8 array."""
        return np.ascontiguousarray(array, dtype=np.int8).reshape(-1)


class _Field(NamedTuple):
    """A field of a message: its element type if it is a numeric sequence, and a function that makes its default."""

    name: str
    dtype: np.dtype[Any] | None
    default: Callable[[], Any]


def _make(type_name: str, **given: Any) -> Any:
    fields = {}
    for name, dtype, default in _fields(type_name):
        if name not in given:
            fields[name] = default()
        else:
            value = given.pop(name)
            fields[name] = value if dtype is None else np.asarray(value, dtype=dtype)
    if given:
        raise TypeError(f"{type_name} has no field {', '.join(given)}")
    return typestore().types[type_name](**fields)


@cache
def _fields(type_name: str) -> tuple[_Field, ...]:
    """The fields of a type, looked up once: a marker alone has forty."""
    fields = typestore().fielddefs[type_name][1]
    return tuple(_Field(name, _element_type(kind), _default(type_name, name, kind)) for name, kind in fields)


def _element_type(kind: Any) -> np.dtype[Any] | None:
    node, detail = kind
    is_sequence = node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
    return _dtype(detail[0]) if is_sequence and _is_numeric(detail[0]) else None


def _default(type_name: str, name: str, kind: Any) -> Callable[[], Any]:
    """A function that returns the default of a field, a new one each time where it could be changed."""
    node, detail = kind
    if node == Nodetype.NAME:
        return partial(_make, detail)
    if node == Nodetype.BASE:
        value = 1.0 if (type_name, name) == ("geometry_msgs/msg/Quaternion", "w") else _zero(detail[0])
        return lambda: value
    element, count = detail
    length = count if node == Nodetype.ARRAY else 0
    if _is_numeric(element):
        return partial(np.zeros, length, dtype=_dtype(element))
    make = _default("", "", element)
    return lambda: [make() for _ in range(length)]


def _zero(base: str) -> Any:
    return "" if base in _TEXT else np.dtype(base.replace("octet", "uint8")).type(0).item()


def _is_numeric(element: Any) -> bool:
    return element[0] == Nodetype.BASE and element[1][0] not in _TEXT


def _dtype(element: Any) -> np.dtype[Any]:
    dtype: np.dtype[Any] = np.dtype(element[1][0].replace("octet", "uint8"))
    return dtype
