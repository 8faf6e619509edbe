"""The simulated cell and every node: ros2 launch push_ident_sim simulation.launch.py"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    config = PathJoinSubstitution([FindPackageShare("push_ident"), "config", "push_ident.yaml"])
    sim_config = PathJoinSubstitution([FindPackageShare("push_ident_sim"), "config", "sim.yaml"])
    on_its_clock = {"use_sim_time": True}
    # A simulator may pause for longer than an arm; the watchdogs of the real one stay as tight as they are.
    patient = {"arm_timeout": 1.0, "tracking_lag": 1.0, "stamp_commands": True}
    nodes = {
        "sim_cell_node": ("push_ident_sim", "sim_params_file", {}),
        "perception_node": ("push_ident", "params_file", on_its_clock),
        "push_executor_node": ("push_ident", "params_file", on_its_clock | patient),
        "identification_node": ("push_ident", "params_file", on_its_clock),
        "gap_diagnosis_node": ("push_ident", "params_file", on_its_clock),
        "goal_pushing_node": ("push_ident", "params_file", on_its_clock),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=config, description="parameters of the nodes"),
            DeclareLaunchArgument("sim_params_file", default_value=sim_config, description="parameters of the simulated cell"),
            DeclareLaunchArgument("log_level", default_value="info"),
            *(
                Node(
                    package=package,
                    executable=executable,
                    name=executable,
                    output="screen",
                    parameters=[LaunchConfiguration(params_file), own],
                    arguments=["--ros-args", "--enclave", f"/push_ident/{executable}", "--log-level", LaunchConfiguration("log_level")],
                )
                for executable, (package, params_file, own) in nodes.items()
            ),
        ]
    )
