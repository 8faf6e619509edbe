"""The nodes beside a real arm: ros2 launch push_ident arm.launch.py

The arm's driver and the camera's run already. Topics of theirs are given where they differ, as in
`joint_trajectory:=/joint_trajectory_controller/joint_trajectory depth_image:=/camera/depth/image_rect_raw`.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TOPICS = {
    "depth_image": "depth/image_rect",
    "camera_info": "depth/camera_info",
    "joint_states": "joint_states",
    "joint_trajectory": "joint_trajectory",
    "wrench": "pusher/wrench",
}
"""Launch argument and the topic of the bag contract that it replaces."""


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("push_ident"), "config", "push_ident.yaml"])
    executables = ("perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node", "goal_pushing_node")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=config, description="parameters of the nodes"),
            DeclareLaunchArgument("log_level", default_value="info"),
            *(
                DeclareLaunchArgument(name, default_value=topic, description=f"topic of the cell for {topic}")
                for name, topic in TOPICS.items()
            ),
            *(
                Node(
                    package="push_ident",
                    executable=executable,
                    name=executable,
                    output="screen",
                    parameters=[LaunchConfiguration("params_file")],
                    remappings=[(topic, LaunchConfiguration(name)) for name, topic in TOPICS.items()],
                    arguments=["--ros-args", "--enclave", f"/push_ident/{executable}", "--log-level", LaunchConfiguration("log_level")],
                )
                for executable in executables
            ),
        ]
    )
