# SPDX-License-Identifier: Apache-2.0
"""All nodes of one or several agents, and the map that joins them; or a bag through them.

    ros2 launch slam_bringup slam.launch.py                                        one rig, stereo
    ros2 launch slam_bringup slam.launch.py mode:=fuse odometry:=ndt rviz:=true
    ros2 launch slam_bringup slam.launch.py bag:=bags/demo mode:=fuse odometry:=ndt
    ros2 launch slam_bringup slam.launch.py agents:=fireman_1,fireman_2 use_sim_time:=true config:=my.yaml
    ros2 launch slam_bringup slam.launch.py set:='ekf_slam.submap.max_distance=1.5, stereo_driver.left_info=left.yaml'

Each agent's nodes live in a namespace of its name; ``sjsam`` stands above them. Static transforms come from your robot
description or a static_transform_publisher. Without ROS's launch, ``slam nodes`` starts the same nodes.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from slam_bringup.processes.kernels import compile_kernels_once
from slam_bringup.processes.launch_plan import ARGUMENTS, plan_launch

SHARE = Path(get_package_share_directory("slam_bringup"))
RVIZ = DeclareLaunchArgument("rviz", default_value="false", choices=["true", "false"], description="start RViz")


def generate_launch_description() -> LaunchDescription:
    """Entry point of ``ros2 launch``."""
    arguments = [
        DeclareLaunchArgument(a.name, default_value=a.default, description=a.description, choices=a.choices or None)
        for a in ARGUMENTS
    ]
    return LaunchDescription([*arguments, RVIZ, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    plan = plan_launch({a.name: LaunchConfiguration(a.name).perform(context) for a in ARGUMENTS})
    compile_kernels_once()
    nodes = [
        Node(
            package=spec.package,
            executable=spec.executable,
            name=spec.executable,
            namespace=spec.namespace,
            parameters=[{k: list(v) if isinstance(v, tuple) else v for k, v in spec.parameters.items()}],
            remappings=list(plan.remappings),
            output="screen",
        )
        for spec in plan.nodes
    ]
    if LaunchConfiguration("rviz").perform(context) == "true":
        nodes.append(Node(package="rviz2", executable="rviz2", arguments=["-d", str(SHARE / "rviz" / "slam.rviz")]))
    return nodes
