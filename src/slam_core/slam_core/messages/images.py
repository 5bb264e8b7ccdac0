# SPDX-License-Identifier: Apache-2.0
"""Images: sensor_msgs/Image and CompressedImage from and to arrays, with every inconsistency named."""

from __future__ import annotations

import struct
from functools import partial

import cv2
import numpy as np

from slam_core.messages.base import Message, MessageTypes, stamp_ns
from slam_core.types import AnyArray, ByteArray, Float32Array, MakeColour, Mask, no_colour

ENCODINGS = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "8UC3": ("u1", 3), "bgr8": ("u1", 3), "rgb8": ("u1", 3), "bgra8": ("u1", 4),
    "rgba8": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1), "8SC1": ("i1", 1), "32FC1": ("f4", 1),
    "64FC1": ("f8", 1), "yuv422": ("u1", 2), "uyvy": ("u1", 2), "yuv422_yuy2": ("u1", 2), "yuyv": ("u1", 2),
    "bayer_rggb8": ("u1", 1), "bayer_bggr8": ("u1", 1), "bayer_gbrg8": ("u1", 1), "bayer_grbg8": ("u1", 1),
}  # fmt: skip
"""Encoding to element type and number of channels."""

_TO_GREY = {
    "bgr8": cv2.COLOR_BGR2GRAY, "8UC3": cv2.COLOR_BGR2GRAY, "rgb8": cv2.COLOR_RGB2GRAY, "bgra8": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY, "yuv422": cv2.COLOR_YUV2GRAY_UYVY, "uyvy": cv2.COLOR_YUV2GRAY_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2GRAY_YUY2, "yuyv": cv2.COLOR_YUV2GRAY_YUY2,
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY, "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY, "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}  # fmt: skip
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "8UC3": cv2.COLOR_BGR2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2, "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}  # fmt: skip
_DEFAULT_ENCODING = {"|u1": "mono8", "|i1": "8SC1", "<u2": "16UC1", "<f4": "32FC1", "<f8": "64FC1"}
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")


def image_message(types: MessageTypes, header: Message, image: AnyArray, encoding: str = "") -> Message:
    """sensor_msgs/Image of an array (height, width) or (height, width, channels).

    ``encoding`` may be left out for mono8, 8SC1, 16UC1, 32FC1 and 64FC1, which follow from the element type.
    """
    image = np.ascontiguousarray(image)
    encoding = encoding or _DEFAULT_ENCODING.get(image.dtype.str, "")
    if encoding not in ENCODINGS:
        raise ValueError(f"no image encoding '{encoding}' for {image.dtype}; known: {', '.join(ENCODINGS)}")
    element, channels = ENCODINGS[encoding]
    if image.dtype != np.dtype(element) or image.shape[2:] != ((channels,) if channels > 1 else ()):
        raise ValueError(f"encoding {encoding} does not fit an array of {image.dtype} and shape {image.shape}")
    height, width = image.shape[:2]
    return types.Image(
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * channels * image.itemsize,
        data=types.octets(image),
    )


def image_from_message(message: Message) -> AnyArray:
    """Pixels (height, width) or (height, width, channels) of an Image or a CompressedImage, in its own encoding.

    Raises
    ------
    ValueError
        For an unknown encoding, a step shorter than a row, or fewer bytes than the size asks for.
    """
    if hasattr(message, "format"):
        return _decompress(message)
    if message.encoding not in ENCODINGS:
        raise ValueError(f"image encoding '{message.encoding}' is not supported; known: {', '.join(ENCODINGS)}")
    element, channels = ENCODINGS[message.encoding]
    dtype = np.dtype(element).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, dtype=np.uint8)
    if step < row:
        raise ValueError(f"image step is {step} bytes but a row of {width} px in {message.encoding} has {row}")
    if len(data) < height * step:
        raise ValueError(f"image is truncated: {height} rows of {step} bytes need {height * step}, got {len(data)}")
    rows = data[: height * step].reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype).reshape((height, width, channels)[: 3 if channels > 1 else 2])
    return pixels if dtype.isnative else pixels.astype(dtype.newbyteorder("="))


def grey_from_message(message: Message) -> ByteArray:
    """A grey image, uint8 (height, width), of a camera image; of 16 bits the upper eight, as cv_bridge does it.

    Raises
    ------
    ValueError
        For floating-point images, whose scale is not known here.
    """
    return _grey(*_decoded(message))


def grey_and_colour_from_message(message: Message) -> tuple[ByteArray, MakeColour]:
    """The grey image of :func:`grey_from_message`, and what makes it in colour.

    Raises
    ------
    ValueError
        For floating-point images, whose scale is not known here.
    """
    image, encoding = _decoded(message)
    is_colour = encoding in _TO_GREY and image.dtype == np.uint8
    return _grey(image, encoding), partial(_colours, image, encoding) if is_colour else no_colour


def mask_from_message(message: Message) -> Mask:
    """A mask: pixels that are not zero are not to be used.

    Raises
    ------
    ValueError
        For an encoding other than mono8 and 8UC1.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise ValueError(f"a mask is mono8 or 8UC1 (0: use, else: leave out), got {message.encoding}")
    return Mask(stamp_ns(message), image_from_message(message))


def picture_from_message(message: Message) -> AnyArray:
    """An image beside a depth image, (height, width): amplitude or intensity as it is, colours as grey."""
    image = image_from_message(message)
    return image if image.ndim == 2 else grey_from_message(message)


def colour_from_message(message: Message) -> ByteArray:
    """A colour image, uint8 (height, width, 3), red first; a grey one has three equal channels.

    Raises
    ------
    ValueError
        For images of other than 8 bits.
    """
    return _colours(*_decoded(message))


def metres_from_message(message: Message) -> Float32Array:
    """Metres, float32 (height, width), of a depth or range image: 16UC1 is mm, 32FC1 m; NaN where there is no value."""
    image = image_from_message(message)
    if image.ndim != 2 or image.dtype not in (np.uint16, np.float32, np.float64):
        raise ValueError(f"a depth image is 16UC1 (mm) or 32FC1 (m), got {image.dtype} of shape {image.shape}")
    scale = np.float32(0.001 if image.dtype == np.uint16 else 1.0)
    metres = image.astype(np.float32) * scale
    return np.where(np.isfinite(metres) & (metres > 0.0), metres, np.float32(np.nan))


def compressed_image_message(types: MessageTypes, header: Message, encoded: bytes, kind: str) -> Message:
    """sensor_msgs/CompressedImage of an encoded file; ``kind`` is "jpeg" or "png"."""
    return types.CompressedImage(header=header, format=kind, data=types.octets(np.frombuffer(encoded, dtype=np.uint8)))


def _decoded(message: Message) -> tuple[AnyArray, str]:
    """Pixels and their encoding; OpenCV decodes a compressed image to grey or to blue first."""
    image = image_from_message(message)
    return image, getattr(message, "encoding", "mono8" if image.ndim == 2 else "bgr8")


def _grey(image: AnyArray, encoding: str) -> ByteArray:
    if image.dtype == np.uint16 and image.ndim == 2:
        return np.asarray(image >> 8, dtype=np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"a grey or colour image with 8 or 16 bits is needed, got {image.dtype}")
    return np.asarray(cv2.cvtColor(image, _TO_GREY[encoding])) if encoding in _TO_GREY else image


def _colours(image: AnyArray, encoding: str) -> ByteArray:
    if image.dtype != np.uint8:
        raise ValueError(f"a colour image with 8 bits is needed, got {image.dtype}")
    if encoding in ("rgb8", "rgba8"):
        return np.ascontiguousarray(image[..., :3])
    if encoding in _TO_RGB:
        return np.asarray(cv2.cvtColor(image, _TO_RGB[encoding]))
    return np.repeat(image[..., None], 3, axis=2)


def _decompress(message: Message) -> AnyArray:
    data = np.frombuffer(message.data, dtype=np.uint8)
    if "compressedDepth" in message.format:
        return _decompress_depth(data, message.format)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise ValueError(f"compressed image of {len(data)} bytes in format '{message.format}' cannot be decoded")
    return np.asarray(image)


def _decompress_depth(data: ByteArray, form: str) -> AnyArray:
    """A compressed_depth_image_transport image: a quantiser in 12 bytes, then a PNG; 32FC1 stores inverse depth."""
    start = _COMPRESSED_DEPTH_HEADER.size
    image = cv2.imdecode(data[start:], cv2.IMREAD_UNCHANGED) if len(data) > start else None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise ValueError(f"compressed depth image of {len(data)} bytes in format '{form}' cannot be decoded")
    if not form.startswith("32FC1"):
        return np.asarray(image)
    _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(data[:start].tobytes())
    values = image.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > 0, np.float32(a) / (values - np.float32(b)), np.float32(np.nan))
