"""All nodes of one or several agents, and the map that joins them.

    ros2 launch slam_bringup slam.launch.py                                        one rig, stereo
    ros2 launch slam_bringup slam.launch.py mode:=fuse odometry:=ndt rviz:=true
    ros2 launch slam_bringup slam.launch.py agents:=fireman_1,fireman_2 use_sim_time:=true config:=my.yaml

Each agent's nodes live in a namespace of its name; ``sjsam`` stands above them. Static transforms come from your robot
description or a static_transform_publisher. Without ROS's launch, ``slam nodes`` starts the same nodes.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from slam_bringup.pipeline.configuration import MODES, ODOMETRIES, choose, load_system_config
from slam_bringup.processes.node_graph import live_nodes

SHARE = Path(get_package_share_directory("slam_bringup"))
ARGUMENTS = (
    DeclareLaunchArgument(
        "agents", default_value="", description="names of the agents, comma-separated; empty: one rig"
    ),
    DeclareLaunchArgument("mode", default_value="stereo", choices=list(MODES), description="where depth comes from"),
    DeclareLaunchArgument("odometry", default_value="none", choices=list(ODOMETRIES), description="of ToF scans"),
    DeclareLaunchArgument("config", default_value="", description="YAML of overrides, one group per node"),
    DeclareLaunchArgument("use_sim_time", default_value="false", choices=["true", "false"]),
    DeclareLaunchArgument("rviz", default_value="false", choices=["true", "false"], description="start RViz"),
)


def generate_launch_description() -> LaunchDescription:
    """Entry point of ``ros2 launch``."""
    profile = SetEnvironmentVariable("FASTRTPS_DEFAULT_PROFILES_FILE", str(SHARE / "config" / "fastdds.xml"))
    threads = SetEnvironmentVariable("OPENBLAS_NUM_THREADS", "1")  # every node has its core; more fight for it
    return LaunchDescription([*ARGUMENTS, profile, threads, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Node]:
    value = {name: LaunchConfiguration(name).perform(context) for name in (a.name for a in ARGUMENTS)}
    config = load_system_config(Path(value["config"]) if value["config"] else None)
    config = choose(config, value["mode"], "sjsam", value["odometry"])
    agents = tuple(name.strip() for name in value["agents"].split(",")) if value["agents"] else ("",)
    sim_time = {"use_sim_time": value["use_sim_time"] == "true"}
    nodes = [
        Node(
            package=spec.package, executable=spec.executable, name=spec.executable, namespace=spec.namespace,
            parameters=[spec.parameters | sim_time], output="screen",
        )
        for spec in live_nodes(config, agents, odometry=value["odometry"] != "none")
    ]  # fmt: skip
    if value["rviz"] == "true":
        nodes.append(Node(package="rviz2", executable="rviz2", arguments=["-d", str(SHARE / "rviz" / "slam.rviz")]))
    return nodes
