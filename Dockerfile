# The suite on the official ROS 2 image; docs/install.md says how to use it.
FROM ros:jazzy

# Ubuntu 24.04 permits pip only so.
ENV PIP_BREAK_SYSTEM_PACKAGES=1 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
SHELL ["/bin/bash", "-c"]
WORKDIR /workspace

# Dependencies first: they change less often than the code. rosdep has no key for statsmodels, NiceGUI and rosbags, and
# brings a typer that does not guess what was mistyped. Pip cannot remove what apt has installed, hence
# --ignore-installed; but rosbags takes the NumPy of apt, which the compiled messages go with.
COPY src src
COPY requirements requirements
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-pip python3-statsmodels \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src --rosdistro jazzy -y \
    && grep -E "^(nicegui|typer)==" requirements/python.txt | xargs pip install --no-cache-dir --ignore-installed \
    && grep "^rosbags==" requirements/python.txt | xargs pip install --no-cache-dir -c requirements/sourced-ros.txt \
    && rm -rf /var/lib/apt/lists/*

RUN source /opt/ros/jazzy/setup.bash && colcon build --base-paths src \
    && printf '%s\n' '#!/bin/bash' 'source /workspace/install/setup.bash' 'exec "$@"' > /entrypoint \
    && chmod 755 /entrypoint

# Whatever reads files of others needs no rights beyond a user's.
USER ubuntu
WORKDIR /home/ubuntu
ENTRYPOINT ["/entrypoint"]
CMD ["ros2", "launch", "dm_bringup", "bench.launch.py"]
