"""Generate tf2_msgs and vision_msgs into the virtual environment that runs this file; `make install` does.

A ROS installation has both packages, and then nothing is done. The ROS wheels have neither, but they have everything
that a message package is built with.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from importlib.util import find_spec
from pathlib import Path

from graph_slam_ros import __version__
from graph_slam_ros.messages.interfaces import INTERFACES

# The wheels' CMake targets name include folders of the machine they were built on, which CMake refuses.
TOP = """\
cmake_minimum_required(VERSION 3.19)
project(interfaces)
function(drop_foreign_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(folders)
      list(FILTER folders EXCLUDE REGEX "^/opt/python/")
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
    endif()
  endforeach()
endfunction()
"""
PACKAGE = """\
project({name})
cmake_language(DEFER CALL drop_foreign_includes)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find_dependencies}
rosidl_generate_interfaces({name} {files} DEPENDENCIES {dependencies})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""
MANIFEST = """\
<package format="3">
  <name>{name}</name>
  <version>{version}</version>
  <description>The messages of {name} that graph_slam_ros uses</description>
  <maintainer email="maintainers@graph-slam-ros.example">The graph_slam_ros maintainers</maintainer>
  <license>Apache-2.0</license>
  {depend}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
DEBIAN_PACKAGES = "sudo apt install g++ python3-dev"
# Left by the wheels' start-up hook or a sourced workspace, they would point the build's own Python elsewhere.
FOREIGN_VARIABLES = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH")


def is_importable(package: str) -> bool:
    """Tell whether Python finds the package; a mere folder of that name does not count."""
    spec = find_spec(package)
    return spec is not None and spec.origin is not None


def write_sources(folder: Path, packages: list[str]) -> None:
    """Write one CMake project with a sub-directory for each package."""
    subdirectories = "".join(f"add_subdirectory({name})\n" for name in packages)
    (folder / "CMakeLists.txt").write_text(TOP + subdirectories)
    for name in packages:
        messages = INTERFACES[name]
        (folder / name / "msg").mkdir(parents=True)
        for message, fields in messages.items():
            (folder / name / "msg" / f"{message}.msg").write_text(fields)
        dependencies = sorted(set(re.findall(r"(\w+)/\w+", "".join(messages.values()))))
        cmake = PACKAGE.format(
            name=name,
            find_dependencies="\n".join(f"find_package({other} REQUIRED)" for other in dependencies),
            files=" ".join(f"msg/{message}.msg" for message in messages),
            dependencies=" ".join(dependencies),
        )
        depend = "".join(f"<depend>{other}</depend>" for other in dependencies)
        (folder / name / "CMakeLists.txt").write_text(cmake)
        (folder / name / "package.xml").write_text(MANIFEST.format(name=name, version=__version__, depend=depend))


def generate(packages: list[str], prefix: Path, into: Path | None = None) -> None:
    """Build the packages with what is below `prefix`, in a temporary folder, and install them there or below `into`.

    Raises
    ------
    subprocess.CalledProcessError
        With CMake's output, when a step fails.
    FileNotFoundError
        When there is no CMake.

    """
    env = {name: value for name, value in os.environ.items() if name not in FOREIGN_VARIABLES}
    env["AMENT_PREFIX_PATH"] = str(prefix)
    env["PATH"] = f"{prefix / 'bin'}{os.pathsep}{env.get('PATH', os.defpath)}"
    definitions = {
        "CMAKE_PREFIX_PATH": prefix,
        "CMAKE_INSTALL_PREFIX": into or prefix,
        "Python3_EXECUTABLE": sys.executable,
        "CMAKE_BUILD_TYPE": "Release",
        "BUILD_TESTING": "OFF",
    }
    with tempfile.TemporaryDirectory() as folder:
        build = f"{folder}/build"
        write_sources(Path(folder), packages)
        for arguments in (
            ["-G", "Ninja", "-S", folder, "-B", build, *(f"-D{name}={value}" for name, value in definitions.items())],
            ["--build", build],
            ["--install", build],
        ):
            subprocess.run(
                ["cmake", *arguments], env=env, check=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )


def obstacle(missing: list[str]) -> str | None:
    """Say why the packages cannot be generated here, and what would help; None if they can."""
    ros = find_spec("rclpy")
    if ros is None:
        return "no ROS 2 here (its wheels are for Linux on x86-64): what needs none works, live graphs do not"
    if not str(ros.origin).startswith(sys.prefix) or sys.prefix == sys.base_prefix:
        packages = " ".join(f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{name.replace('_', '-')}" for name in missing)
        return f"the installed ROS lacks {' and '.join(missing)}: sudo apt install {packages}"
    has_compiler = os.environ.get("CXX") or any(map(shutil.which, ("c++", "g++", "clang++")))
    if not has_compiler or not Path(sysconfig.get_path("include"), "Python.h").exists():
        return f"no ROS 2 without a compiler and Python's headers for {' and '.join(missing)}: {DEBIAN_PACKAGES}"
    return None


def main() -> int:
    """Generate what is missing; return 0 if nothing is missing any more."""
    missing = [name for name in INTERFACES if not is_importable(name)]
    if not missing:
        return 0
    reason = obstacle(missing)
    if reason is None:
        try:
            generate(missing, Path(sys.prefix))
        except (subprocess.CalledProcessError, OSError) as error:
            sys.stderr.write(getattr(error, "output", ""))
            reason = f"cannot generate {' and '.join(missing)}: {error}"
    if reason is not None:
        sys.stderr.write(f"graph_slam_ros: {reason}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
