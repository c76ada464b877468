# docker build --tag us_sim .
# docker run --rm -it --network host --ipc host us_sim ros2 launch us_sim us_sim.launch.py
ARG ROS=jazzy
FROM ros:${ROS}
SHELL ["/bin/bash", "-euo", "pipefail", "-c"]
WORKDIR /ws
COPY . src/us_sim
# docs/ros2.md says what pip has to bring upon Ubuntu 24.04; later ones have a newer NumPy.
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-pip ros-$ROS_DISTRO-rmw-cyclonedds-cpp \
 && rosdep update && rosdep install --from-paths src --ignore-src -y \
 && line=$(grep '^pip install --break-system-packages' src/us_sim/docs/ros2.md) \
 && if [[ $ROS_DISTRO != @(jazzy|kilted) ]]; then line=${line/<2/}; line=${line/,<4.12/}; fi \
 && eval "$line" \
 && (set +u; . /opt/ros/$ROS_DISTRO/setup.bash; colcon build) \
 && rm -rf /var/lib/apt/lists/*
ENTRYPOINT ["/bin/bash", "-c", ". /ws/install/setup.bash && exec \"$@\"", "us_sim"]
CMD ["ros2", "run", "us_sim", "us-sim", "--help"]
