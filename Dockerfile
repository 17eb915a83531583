# The commands without ROS, from a wheel that `make wheel PYTHON=python3.12` made:
#   docker build -t graph_slam . && docker run --rm -v "$PWD:/data" --user "$(id -u)" graph_slam demo
FROM python:3.12-slim
COPY dist/*-cp312-*x86_64.whl /tmp/
RUN pip install --no-cache-dir /tmp/*.whl && rm /tmp/*.whl && useradd --create-home slam && install -d -o slam /data
USER slam
WORKDIR /data
ENTRYPOINT ["graph_slam"]
