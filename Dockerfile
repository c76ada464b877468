# docker build --tag us_sim .
# docker run --rm -it --network host --ipc host us_sim ros2 launch us_sim us_sim.launch.py
ARG ROS=jazzy
FROM ros:${ROS}
SHELL ["/bin/bash", "-euo", "pipefail", "-c"]
WORKDIR /ws
COPY . src/us_sim
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-pip ros-$ROS_DISTRO-rmw-cyclonedds-cpp \
 && rosdep update && rosdep install --from-paths src --ignore-src -y \
 && pip install --break-system-packages -r src/us_sim/.ci/requirements-ubuntu.txt \
 && (set +u; . /opt/ros/$ROS_DISTRO/setup.bash; colcon build) \
 && rm -rf /var/lib/apt/lists/*
ENTRYPOINT ["/bin/bash", "-c", ". /ws/install/setup.bash && exec \"$@\"", "us_sim"]
CMD ["ros2", "run", "us_sim", "us-sim", "--help"]
