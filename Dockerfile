# SPDX-License-Identifier: Apache-2.0
# ROS 2 Jazzy with this package built: docker build -t smp_motor_control . && docker run --rm -it smp_motor_control
FROM ros:jazzy AS dependencies
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# Ubuntu 24.04 refuses pip without it, rosdep's too.
ENV PIP_BREAK_SYSTEM_PACKAGES=1 PIP_NO_CACHE_DIR=1
WORKDIR /workspace
COPY package.xml src/smp_motor_control/
# Versions are those of the distribution and of package.xml.
# hadolint ignore=DL3008,DL3013
RUN apt-get update && \
    apt-get install --yes --no-install-recommends python3-pip python3-venv && \
    rosdep update --rosdistro jazzy && \
    rosdep install --from-paths src --ignore-src --default-yes && \
    pip install mcap msgspec && \
    rm -rf /var/lib/apt/lists/*

FROM dependencies
COPY . src/smp_motor_control
RUN . /opt/ros/jazzy/setup.bash && colcon build
ENTRYPOINT ["/bin/bash", "-c", ". /workspace/install/setup.bash && exec \"$0\" \"$@\""]
CMD ["bash"]
