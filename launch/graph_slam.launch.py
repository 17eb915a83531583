"""Start the SLAM node: ``ros2 launch graph_slam_ros graph_slam.launch.py odom:=/wheel/odometry rviz:=true``.

With ``preset:=tags image:=/camera/image_rect tag_size:=0.16``, say, a detector of tags as well: apriltag_ros.

A plain node action, not a LifecycleNode: the node brings itself up, or a lifecycle manager does (``autostart:=false``),
and so this process needs no ROS node of its own.
"""

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def _in_config(name: str) -> PathJoinSubstitution:
    return PathJoinSubstitution([FindPackageShare("graph_slam_ros"), "config", name])


def _flag(name: str) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=bool)


def _frames(context: LaunchContext) -> dict[str, str]:
    """Nothing without a prefix, so that the frames of params_file stay."""
    prefix = LaunchConfiguration("frame_prefix").perform(context)
    names = {"frames.map": "map", "frames.odom": "odom", "frames.base": "base_link"}
    return {key: prefix + name for key, name in names.items()} if prefix else {}


def _folder(context: LaunchContext) -> dict[str, str]:
    """Nothing without an argument, so that the folder of params_file stays: by default one for each node."""
    folder = LaunchConfiguration("folder").perform(context)
    return {"output.folder": folder} if folder else {}


def _files(context: LaunchContext) -> list[Any]:
    """The preset, below the file of parameters; without both the shipped parameters, which are the defaults."""
    preset, file = (LaunchConfiguration(name).perform(context) for name in ("preset", "params_file"))
    presets = [_in_config(f"presets/{preset}.yaml")] if preset else []
    return [*presets, *([file] if file else [])] or [_in_config("planar.yaml")]


def _start(context: LaunchContext) -> list[Node]:
    namespace = LaunchConfiguration("namespace")
    slam = Node(
        package="graph_slam_ros",
        executable="graph_slam_node",
        namespace=namespace,
        parameters=[
            *_files(context),
            {
                "use_sim_time": _flag("use_sim_time"),
                "node.autostart": _flag("autostart"),
                **_frames(context),
                **_folder(context),
            },
        ],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in ("odom", "landmarks")],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
    )
    # The file's topics are relative, so that RViz in the robot's namespace shows this robot.
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=namespace,
        arguments=["-d", _in_config("graph_slam.rviz"), "-f", [LaunchConfiguration("frame_prefix"), "map"]],
        parameters=[{"use_sim_time": _flag("use_sim_time")}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    image = LaunchConfiguration("image").perform(context)
    camera = image[: image.rfind("/") + 1]
    detector = Node(
        package="apriltag_ros",
        executable="apriltag_node",
        namespace=namespace,
        parameters=[
            {
                "size": ParameterValue(LaunchConfiguration("tag_size"), value_type=float),
                "use_sim_time": _flag("use_sim_time"),
            }
        ],
        remappings=[("image_rect", image), ("camera_info", f"{camera}camera_info")],
        output="screen",
    )
    return [slam, rviz, *([detector] if image else [])]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its topics"),
            DeclareLaunchArgument("preset", default_value="", description="tags, poles, gnss, ranges or closures"),
            DeclareLaunchArgument(
                "params_file",
                default_value="",
                description="Parameters on top of the preset; without both planar.yaml",
            ),
            DeclareLaunchArgument(
                "frame_prefix",
                default_value="",
                description="Put before map, odom and base_link, which then are the frames whatever params_file says",
            ),
            DeclareLaunchArgument(
                "folder",
                default_value="",
                description="Run folder; without it that of params_file, by default NAMESPACE_graph_slam_run",
            ),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Take the time from /clock"),
            DeclareLaunchArgument(
                "autostart", default_value="true", description="false: a lifecycle manager configures and activates it"
            ),
            DeclareLaunchArgument("odom", default_value="odom", description="Topic of nav_msgs/Odometry"),
            DeclareLaunchArgument("landmarks", default_value="landmarks", description="Topic of Detection3DArray"),
            DeclareLaunchArgument(
                "image",
                default_value="",
                description="Topic of rectified images: apriltag_ros looks for tags in them",
            ),
            DeclareLaunchArgument(
                "tag_size", default_value="1.0", description="Edge of these tags in metres: distances scale with it"
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="Open RViz as well"),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
            OpaqueFunction(function=_start),
        ]
    )
