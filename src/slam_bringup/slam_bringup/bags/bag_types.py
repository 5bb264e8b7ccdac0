# SPDX-License-Identifier: Apache-2.0
"""Messages of bags: rosbags classes with defaults and numpy fields, behind the :class:`MessageTypes` of slam_core."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

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


def _make(type_name: str, **given: Any) -> Any:
    fields = {}
    for name, kind in typestore().fielddefs[type_name][1]:
        fields[name] = _as_field(kind, given.pop(name)) if name in given else _default(type_name, name, kind)
    if given:
        raise TypeError(f"{type_name} has no field {', '.join(given)}")
    return typestore().types[type_name](**fields)


def _as_field(kind: Any, value: Any) -> Any:
    """Numeric sequences become numpy arrays of the field's element type; everything else stays."""
    node, detail = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) and _is_numeric(detail[0]):
        return np.asarray(value, dtype=_dtype(detail[0]))
    return value


def _default(type_name: str, name: str, kind: Any) -> Any:
    node, detail = kind
    if node == Nodetype.NAME:
        return _make(detail)
    if node == Nodetype.BASE:
        if (type_name, name) == ("geometry_msgs/msg/Quaternion", "w"):
            return 1.0
        return "" if detail[0] in _TEXT else np.dtype(detail[0].replace("octet", "uint8")).type(0).item()
    element, count = detail
    length = count if node == Nodetype.ARRAY else 0
    return (
        np.zeros(length, dtype=_dtype(element))
        if _is_numeric(element)
        else [_default("", "", element) for _ in range(length)]
    )


def _is_numeric(element: Any) -> bool:
    return element[0] == Nodetype.BASE and element[1][0] not in _TEXT


def _dtype(element: Any) -> np.dtype[Any]:
    dtype: np.dtype[Any] = np.dtype(element[1][0].replace("octet", "uint8"))
    return dtype
