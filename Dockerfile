# Two images, of the wheels that `make wheel PYTHON=python3.12` made; neither runs as root.
#   commands: docker build -t graph_slam . && docker run --rm -v "$PWD:/data" --user "$(id -u)" graph_slam demo
#   node:     docker build -t graph_slam_node --target node . && docker run --rm --net host --ipc host graph_slam_node
#   RViz:     docker run --rm --net host --ipc host -e DISPLAY -v /tmp/.X11-unix:/tmp/.X11-unix graph_slam_node \
#               ros2 launch graph_slam_ros graph_slam.launch.py rviz:=true
FROM ros:jazzy-ros-base AS node
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-venv ros-jazzy-rviz2 ros-jazzy-vision-msgs \
    && rm -rf /var/lib/apt/lists/*
# The messages of Jazzy need its NumPy; where launch files look for executables, there are those of the environment.
RUN --mount=type=bind,source=dist,target=/wheels python3 -m venv --system-site-packages /opt/slam \
    && /opt/slam/bin/pip install --no-cache-dir --no-index --no-deps --find-links /wheels graph_slam_ros \
    && /opt/slam/bin/pip install --no-cache-dir graph_slam_ros 'numpy<2' \
    && ln -s ../bin /opt/slam/lib/graph_slam_ros \
    && useradd --create-home slam && install -d -o slam /data
ENV AMENT_PREFIX_PATH=/opt/slam PATH=/opt/slam/bin:$PATH
USER slam
WORKDIR /data
CMD ["ros2", "launch", "graph_slam_ros", "graph_slam.launch.py"]

FROM python:3.12-slim AS commands
RUN --mount=type=bind,source=dist,target=/wheels \
    pip install --no-cache-dir --no-index --no-deps --find-links /wheels graph_slam_ros \
    && pip install --no-cache-dir graph_slam_ros \
    && useradd --create-home slam && install -d -o slam /data
USER slam
WORKDIR /data
ENTRYPOINT ["graph_slam"]
