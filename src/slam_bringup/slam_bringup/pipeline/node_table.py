# SPDX-License-Identifier: Apache-2.0
"""The nodes, declared once: where each is, its topics, and what a run must know of it.

Launch file, ``slam nodes``, the composed process, the pages of parameters and the figure of the data's way all read
this table. The modules are named, not imported: they need ROS.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

_STEREO_IN = ("stereo/{left,right}/image_raw", "stereo/{left,right}/camera_info")
_RECTIFIED = ("stereo/{left,right}/image_rect", "stereo/{left,right}/camera_info")
_TOF_IN = ("tof/range/image_raw", "tof/amplitude/image_raw", "tof/intensity/image_raw", "tof/camera_info")
_DEPTH = ("tof/depth/image", "tof/noise/image", "tof/camera_info")
_FEATURES = ("features", "features/descriptors", "features/camera_info")
_KEY_FRAME = ("view/depth/image", "view/noise/image", "view/camera_info", "view/color/image", "view/anchor")
_SUBMAP = ("submap/landmarks", "submap/info", "submap/path", "submap/gaussian", "submap/descriptors")


@dataclass(frozen=True)
class NodeDeclaration:
    """One node.

    module: of its ``main``; node: class in it; config: ``module:class`` of its parameters. inputs, outputs: its main
    topics, relative. holds_frames: it waits for other sensors, and is told when the input has ended. recorded: topics
    that ``slam nodes`` records. is_tool: it is no part of the chain, and a file of parameters has no group for it.
    """

    package: str
    executable: str
    module: str
    node: str
    config: str
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    holds_frames: bool = False
    recorded: tuple[str, ...] = ()
    is_tool: bool = False

    def load_config_class(self) -> Any:
        """The class of the node's parameters; ImportError without ROS."""
        return _load(self.config)

    def load_node_class(self) -> Any:
        """The class of the node; ImportError without ROS."""
        return _load(f"{self.module}:{self.node}")


NODES = (
    NodeDeclaration(
        "stereo_frontend", "stereo_driver", "stereo_frontend.driver_node", "StereoDriverNode",
        "stereo_frontend.driver_node:StereoDriverConfig", inputs=_STEREO_IN, outputs=_RECTIFIED,
    ),
    NodeDeclaration(
        "tof_driver", "tof_driver", "tof_driver.node", "TofDriverNode", "tof_driver.node:TofDriverConfig",
        inputs=_TOF_IN,
        outputs=(*_DEPTH, "tof/amplitude/image", "tof/intensity/image", "tof/color/image", "tof/points"),
    ),
    NodeDeclaration(
        "ndt_registration", "ndt_odometry", "ndt_registration.node", "NdtNode", "ndt_registration.node:NdtNodeConfig",
        inputs=("tof/points", "scan", "imu"), outputs=("ndt/odometry", "ndt/motion"), holds_frames=True,
        recorded=("ndt/odometry", "ndt/motion"),
    ),
    NodeDeclaration(
        "stereo_frontend", "feature_extractor", "stereo_frontend.node", "FeatureNode",
        "stereo_frontend.node:FrontendConfig",
        inputs=(*_RECTIFIED, *_DEPTH, "tof/amplitude/image", "mask"), outputs=_FEATURES,
        holds_frames=True, recorded=("features",),
    ),
    NodeDeclaration(
        "ekf_slam_node", "ekf_slam", "ekf_slam_node.node", "EkfNode", "ekf_slam_node.node:EkfNodeConfig",
        inputs=(*_FEATURES, "ndt/motion", "odometry", "imu", "pressure"), outputs=("odom", "landmarks", *_SUBMAP),
        holds_frames=True,
        recorded=("odom", "landmarks", "submap/landmarks", "submap/info", "submap/path"),
    ),
    NodeDeclaration(
        "slam_radio", "radio_link", "slam_radio.radio_link_node", "RadioLinkNode",
        "slam_radio.radio_config:RadioConfig",
        inputs=(*_SUBMAP, "odom", "stereo/left/image_rect", "stereo/left/image_rect_color", "stereo/left/camera_info",
                *_DEPTH, "tof/color/image", "map/path", "wanted_picture", "wanted_key_frame"),
        outputs=("map_to_odom", *_KEY_FRAME, "view/picture/compressed", "view/pose"),
    ),
    NodeDeclaration(
        "sjsam_node", "sjsam", "sjsam_node.node", "SjsamNode", "sjsam_node.node_config:SjsamNodeConfig",
        inputs=(*_SUBMAP, "odom", "position", "clicked_point", "initialpose"),
        outputs=("map/landmarks", "map/path", "map/graph", "map/ellipsoids", "map/cloud", "map/marks", "map_to_odom",
                 "map_to_odom_pose", "pose"),
        recorded=("pose", "map_to_odom", "map/landmarks", "map/path", "map/graph", "map/ellipsoids", "map/cloud",
                  "map/marks"),
    ),
    NodeDeclaration(
        "dense_mapping", "dense_mapper", "dense_mapping.node", "DenseMapperNode", "dense_mapping.node:DenseNodeConfig",
        inputs=(*_DEPTH, "tof/color/image", *_RECTIFIED, "mask", "tof/mask", "odom", "map/path", "pose", "imu",
                *_KEY_FRAME),
        outputs=("map/dense_cloud", "map/occupancy", "storey", "storey/occupancy"),
    ),
    NodeDeclaration(
        "slam_viewer", "viewer", "slam_viewer.viewer_node", "ViewerNode", "slam_viewer.viewer_node:ViewerConfig",
        inputs=("odom", "map/landmarks", "map/path", "map/graph", "map/dense_cloud", "map/occupancy",
                "view/picture/compressed", "view/pose"),
        outputs=("clicked_point", "wanted_picture", "wanted_key_frame"), is_tool=True,
    ),
    NodeDeclaration(
        "slam_bags", "bag_player", "slam_bags.nodes.bag_player_node", "BagPlayerNode",
        "slam_bags.nodes.bag_player_node:PlayerConfig", is_tool=True,
    ),
    NodeDeclaration(
        "slam_bags", "recorder", "slam_bags.nodes.recorder_node", "RecorderNode",
        "slam_bags.nodes.recorder_node:RecorderConfig", is_tool=True,
    ),
)  # fmt: skip
"""Front to back, as a composed process starts them; the tools last."""

_BY_NAME = {declared.executable: declared for declared in NODES}
RESULT_TOPICS = tuple(topic for declared in NODES for topic in declared.recorded)
"""Topics that ``slam nodes`` records, below each agent's namespace and at the root."""


def node_named(executable: str) -> NodeDeclaration:
    """The declaration of an executable; KeyError if there is none."""
    return _BY_NAME[executable]


def is_node(executable: str) -> bool:
    """True if there is a node of that name."""
    return executable in _BY_NAME


def _load(where: str) -> Any:
    module, _, name = where.partition(":")
    return getattr(importlib.import_module(module), name)
