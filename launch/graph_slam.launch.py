"""Start the SLAM node: ``ros2 launch graph_slam_ros graph_slam.launch.py odom:=/wheel/odometry``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    default_params = PathJoinSubstitution([FindPackageShare("graph_slam_ros"), "config", "planar.yaml"])
    arguments = [
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its topics"),
        DeclareLaunchArgument("params_file", default_value=default_params, description="YAML file of parameters"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="Take the time from /clock"),
        DeclareLaunchArgument("odom", default_value="odom", description="Topic of nav_msgs/Odometry"),
        DeclareLaunchArgument("landmarks", default_value="landmarks", description="Topic of Detection3DArray"),
    ]
    node = Node(
        package="graph_slam_ros",
        executable="graph_slam_node",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params_file"),
            {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)},
        ],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in ("odom", "landmarks")],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
