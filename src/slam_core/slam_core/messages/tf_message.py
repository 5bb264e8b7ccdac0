# SPDX-License-Identifier: Apache-2.0
"""``tf2_msgs/msg/TFMessage`` where tf2_msgs is not installed: it has no wheel on PyPI, and ``/tf`` needs it.

rclpy reads a message's type through a C structure, the type support, which holds names, a hash, a description of the
fields for discovery, and functions that turn the message into bytes. For a list of TransformStamped it is made here
from that of TransformStamped, which is installed. The functions are not replaced, since bytes are sent and received as
they are (:func:`transforms_to_octets`, :func:`transforms_from_octets`), nor is the description that a node's service
gives of the type, which is then TransformStamped's. Layouts are those of
rosidl_runtime_c 4.6, rosidl_typesupport_fastrtps_cpp 3.6 and rosidl_typesupport_introspection_c 4.6
(``message_type_support_struct.h``, ``message_type_support.h``, ``message_introspection.h``); before anything is made,
what TransformStamped is known to say must be found at these places.
"""

from __future__ import annotations

import ctypes
import functools
import struct
from collections.abc import Iterable
from typing import Any

from slam_core.messages import MessageTypes
from slam_core.messages.base import Message

TYPE_HASH = bytes.fromhex("01e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087")
"""Version and SHA-256 of the description of tf2_msgs/msg/TFMessage, as REP-2016 makes it."""

_DISPATCH, _BYTES, _FIELDS = (b"rosidl_typesupport_" + name for name in (b"c", b"fastrtps_c", b"introspection_c"))
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_SEQUENCE_BYTES = 24  # of the C structure of a sequence: pointer, size, capacity

_GetHandle = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_GetHash = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_API = ctypes.PyDLL(None)
_API.PyCapsule_New.restype = ctypes.py_object
_API.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_API.PyCapsule_GetPointer.restype = ctypes.c_void_p
_API.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]


class _Handle(ctypes.Structure):
    """``rosidl_message_type_support_t``."""

    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("get_handle", ctypes.c_void_p),
        ("get_hash", ctypes.c_void_p),
        ("get_description", ctypes.c_void_p),
        ("get_sources", ctypes.c_void_p),
    )


class _Functions(ctypes.Structure):
    """``message_type_support_callbacks_t``: names, then five functions."""

    _fields_ = (("namespace", ctypes.c_char_p), ("name", ctypes.c_char_p), ("functions", ctypes.c_void_p * 5))


class _Field(ctypes.Structure):
    """``rosidl_typesupport_introspection_c__MessageMember``."""

    _fields_ = (
        ("name", ctypes.c_char_p), ("type_id", ctypes.c_uint8), ("string_bound", ctypes.c_size_t),
        ("members", ctypes.c_void_p), ("is_key", ctypes.c_bool), ("is_array", ctypes.c_bool),
        ("array_size", ctypes.c_size_t), ("is_bounded", ctypes.c_bool), ("offset", ctypes.c_uint32),
        ("default", ctypes.c_void_p), ("functions", ctypes.c_void_p * 6),
    )  # fmt: skip


class _Message(ctypes.Structure):
    """``rosidl_typesupport_introspection_c__MessageMembers``."""

    _fields_ = (
        ("namespace", ctypes.c_char_p), ("name", ctypes.c_char_p), ("count", ctypes.c_uint32),
        ("size", ctypes.c_size_t), ("has_key", ctypes.c_bool), ("fields", ctypes.c_void_p),
        ("initialize", ctypes.c_void_p), ("finalize", ctypes.c_void_p),
    )  # fmt: skip


class _TypeSupport:
    """The structures of TFMessage, kept alive together; ``address`` is that of its dispatching handle."""

    def __init__(self, element: int) -> None:
        dispatch = _Handle.from_address(element)
        handle_of = _GetHandle(dispatch.get_handle)
        as_bytes, as_fields = (_Handle.from_address(handle_of(element, i) or element) for i in (_BYTES, _FIELDS))
        _check(dispatch.identifier == _DISPATCH and as_bytes.identifier == _BYTES and as_fields.identifier == _FIELDS)
        functions, message = _Functions.from_address(as_bytes.data), _Message.from_address(as_fields.data)
        _check((functions.namespace, functions.name) == (b"geometry_msgs::msg", b"TransformStamped"))
        _check((message.namespace, message.name, message.count) == (b"geometry_msgs__msg", b"TransformStamped", 3))
        header = _Field.from_address(message.fields)
        _check((header.name, header.is_array, header.offset) == (b"header", False, 0))

        self._hash = ctypes.create_string_buffer(TYPE_HASH, len(TYPE_HASH))
        self._get_hash = _GetHash(lambda _: ctypes.addressof(self._hash))
        self._functions = _copy(functions, namespace=b"tf2_msgs::msg", name=b"TFMessage")
        self._field = _Field(
            name=b"transforms", type_id=header.type_id, members=ctypes.addressof(as_fields), is_array=True
        )
        self._message = _copy(
            message,
            namespace=b"tf2_msgs__msg",
            name=b"TFMessage",
            count=1,
            size=_SEQUENCE_BYTES,
            fields=ctypes.addressof(self._field),
        )
        self._handles = {
            _BYTES: self._handle(as_bytes, data=ctypes.addressof(self._functions)),
            _FIELDS: self._handle(as_fields, data=ctypes.addressof(self._message)),
        }
        self._get_handle = _GetHandle(lambda _, identifier: self._address(identifier))
        self._dispatch = self._handle(dispatch, get_handle=ctypes.cast(self._get_handle, ctypes.c_void_p).value)
        self.address = ctypes.addressof(self._dispatch)

    def _handle(self, of: _Handle, **changes: Any) -> _Handle:
        out: _Handle = _copy(of, get_hash=ctypes.cast(self._get_hash, ctypes.c_void_p).value, **changes)
        return out

    def _address(self, identifier: bytes) -> int | None:
        handle = self._handles.get(identifier)
        return None if handle is None else ctypes.addressof(handle)


@functools.cache
def tf_message_class(transform_stamped: Any) -> Any:
    """A class that rclpy makes publishers and raw subscriptions of; calling it gives the bytes of a message.

    ``transform_stamped``: rclpy's class of geometry_msgs/msg/TransformStamped. ImportError where its type support is
    not as described above.
    """
    kind = type(transform_stamped)
    if kind._TYPE_SUPPORT is None:
        kind.__import_type_support__()
    support = _TypeSupport(_API.PyCapsule_GetPointer(kind._TYPE_SUPPORT, None))
    # rclpy wants the conversions to be there; they are for messages that are no bytes, which there are none of.
    names = ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE")
    capsule = _API.PyCapsule_New(support.address, None, None)
    described = type("Metaclass_TFMessage", (type,), {"_TYPE_SUPPORT": capsule, **dict.fromkeys(names, object())})
    return described(
        "TFMessage", (), {"support": support, "__new__": lambda _, transforms=(): transforms_to_octets(transforms)}
    )


def transforms_to_octets(transforms: Iterable[Message]) -> bytes:
    """CDR of a tf2_msgs/msg/TFMessage of TransformStamped messages."""
    transforms = list(transforms)
    out = bytearray(struct.pack("<I", len(transforms)))
    for message in transforms:
        stamp, t, q = message.header.stamp, message.transform.translation, message.transform.rotation
        _pack(out, 4, "<iI", stamp.sec, stamp.nanosec)
        for name in (message.header.frame_id, message.child_frame_id):
            text = name.encode() + b"\0"
            _pack(out, 4, f"<I{len(text)}s", len(text), text)
        _pack(out, 8, "<7d", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
    return _LITTLE_ENDIAN + bytes(out)


def transforms_from_octets(types: MessageTypes, octets: bytes) -> list[Message]:
    """TransformStamped messages of the CDR of a tf2_msgs/msg/TFMessage; ValueError if it is none."""
    if len(octets) < 8 or octets[0] != 0 or octets[1] > 1:
        raise ValueError(f"no CDR of version 1: it begins with {octets[:4].hex()}")
    reader = _Reader(octets[4:], "<" if octets[1] else ">")
    try:
        return [reader.transform(types) for _ in range(reader.take(4, "I")[0])]
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"no TFMessage: {error}") from None


class _Reader:
    """Takes values off the front of CDR, each at a multiple of its size."""

    def __init__(self, body: bytes, order: str) -> None:
        self._body, self._order, self._at = body, order, 0

    def take(self, size: int, form: str) -> tuple[Any, ...]:
        self._at += -self._at % size
        values = struct.unpack_from(self._order + form, self._body, self._at)
        self._at += struct.calcsize(self._order + form)
        return values

    def text(self) -> str:
        (length,) = self.take(4, "I")
        return bytes(self.take(1, f"{length}s")[0]).rstrip(b"\0").decode()

    def transform(self, types: MessageTypes) -> Message:
        sec, nanosec = self.take(4, "iI")
        header = types.Header(stamp=types.Time(sec=sec, nanosec=nanosec), frame_id=self.text())
        child = self.text()
        values = self.take(8, "7d")
        pose = types.Transform(
            translation=types.Vector3(x=values[0], y=values[1], z=values[2]),
            rotation=types.Quaternion(x=values[3], y=values[4], z=values[5], w=values[6]),
        )
        return types.TransformStamped(header=header, child_frame_id=child, transform=pose)


def _pack(out: bytearray, size: int, form: str, *values: Any) -> None:
    out.extend(b"\0" * (-len(out) % size))
    out.extend(struct.pack(form, *values))


def _check(agrees: bool) -> None:
    if not agrees:
        raise ImportError("this rclpy describes its messages otherwise: without tf2_msgs there is no /tf")


def _copy(of: Any, **changes: Any) -> Any:
    out = type(of)()
    ctypes.memmove(ctypes.byref(out), ctypes.byref(of), ctypes.sizeof(out))
    for name, value in changes.items():
        setattr(out, name, value)
    return out
