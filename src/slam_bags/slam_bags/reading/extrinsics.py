# SPDX-License-Identifier: Apache-2.0
"""The static transform between two cameras: ``extrinsics.yaml`` for slam, ``extrinsics.urdf`` for a robot, one line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from slam_core.geometry import FloatArray, pose7_from_transform, quaternion_from_rotation, transform_from_pose7
from slam_core.storage.files import read_yaml

EXTRINSICS, URDF = "extrinsics.yaml", "extrinsics.urdf"


@dataclass(frozen=True, eq=False)
class StaticTransform:
    """T_parent_child between two frames of a rig.

    pose: (7,) ``x y z qx qy qz qw`` with the numbers of its source, which a way through a matrix would round.
    """

    parent: str
    child: str
    pose: FloatArray

    def __post_init__(self) -> None:
        if self.pose.shape != (7,):
            raise ValueError(f"a pose has seven numbers, got {self.pose.size}")
        transform_from_pose7(self.pose)  # ValueError where the quaternion is none

    @property
    def T(self) -> FloatArray:
        """T_parent_child (4, 4)."""
        return transform_from_pose7(self.pose)

    @property
    def text(self) -> str:
        """``PARENT CHILD x y z qx qy qz qw``."""
        numbers = " ".join(repr(float(v)) for v in self.pose)
        return f"{self.parent} {self.child} {numbers}"

    @classmethod
    def parse(cls, text: str) -> StaticTransform:
        """Transform from its :attr:`text`; ValueError if it is none."""
        try:
            parent, child, *numbers = text.split()
            return cls(parent, child, np.array(numbers, dtype=np.float64))
        except ValueError as error:
            raise ValueError(f"'{text}' is not PARENT CHILD x y z qx qy qz qw: {error}") from error


def extrinsics_text(parent: str, child: str, T: FloatArray, covariance: FloatArray) -> str:
    """YAML of T_parent_child (4, 4) with its covariance (6, 6), translation (m) before rotation (rad).

    Its first line is the command that publishes the transform.
    """
    deviations = np.sqrt(np.diag(covariance)).tolist()
    document = {
        "parent_frame": parent,
        "child_frame": child,
        "translation_m": T[:3, 3].tolist(),
        "rotation_xyzw": quaternion_from_rotation(T[:3, :3]).tolist(),
        "standard_deviations": dict(zip(("x", "y", "z", "rx", "ry", "rz"), deviations, strict=True)),
        "covariance": covariance.tolist(),
    }
    return f"# {_publisher(parent, child, T)}\n{yaml.safe_dump(document, sort_keys=False, default_flow_style=None)}"


def read_extrinsics(path: Path) -> StaticTransform:
    """The transform of an ``extrinsics.yaml``; ValueError if the file is none."""
    try:
        document = read_yaml(path)
        pose = np.array([*document["translation_m"], *document["rotation_xyzw"]], dtype=np.float64)
        return StaticTransform(str(document["parent_frame"]), str(document["child_frame"]), pose)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no extrinsics file of slam calibrate: {error}") from error


def extrinsics_urdf(parent: str, child: str, T: FloatArray) -> str:
    """A link and a fixed joint of T_parent_child (4, 4) to paste into a robot's description."""
    from scipy.spatial.transform import Rotation  # 0.3 s, which a player of bags need not spend

    xyz = " ".join(f"{value:.9g}" for value in T[:3, 3])
    rpy = " ".join(f"{angle:.9g}" for angle in Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))
    return f"""\
<link name={quoteattr(child)}/>
<joint name={quoteattr(f"{child}_joint")} type="fixed">
  <parent link={quoteattr(parent)}/>
  <child link={quoteattr(child)}/>
  <origin xyz="{xyz}" rpy="{rpy}"/>
</joint>
"""


def _publisher(parent: str, child: str, T: FloatArray) -> str:
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    pose = " ".join(f"--{name} {value:.9g}" for name, value in zip(names, pose7_from_transform(T), strict=True))
    return f"ros2 run tf2_ros static_transform_publisher {pose} --frame-id {parent} --child-frame-id {child}"
