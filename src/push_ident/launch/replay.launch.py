"""A bag through the live nodes: ros2 launch push_ident replay.launch.py bag:=PATH"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("push_ident"), "config", "push_ident.yaml"])
    params_file = LaunchConfiguration("params_file")

    def arguments(executable: str) -> list[object]:
        return ["--ros-args", "--enclave", f"/push_ident/{executable}", "--log-level", LaunchConfiguration("log_level")]

    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="bag to play: a folder or a file of the bag contract"),
            DeclareLaunchArgument("perception", default_value="true", description="false where the bag holds object poses already"),
            DeclareLaunchArgument("params_file", default_value=config, description="parameters of the nodes"),
            DeclareLaunchArgument("log_level", default_value="info"),
            Node(
                package="push_ident",
                executable="perception_node",
                name="perception_node",
                output="screen",
                parameters=[params_file, {"use_sim_time": True, "every_image": True}],
                arguments=arguments("perception_node"),
                condition=IfCondition(LaunchConfiguration("perception")),
            ),
            Node(
                package="push_ident",
                executable="identification_node",
                name="identification_node",
                output="screen",
                parameters=[params_file, {"use_sim_time": True, "source": "bag_player_node"}],
                arguments=arguments("identification_node"),
            ),
            Node(
                package="push_ident",
                executable="bag_player_node",
                name="bag_player_node",
                output="screen",
                parameters=[params_file, {"bag": LaunchConfiguration("bag"), "follower": "perception_node"}],
                arguments=arguments("bag_player_node"),
            ),
        ]
    )
