# Crash Coach on a ROS 2 Jazzy distribution:
#     docker build -t crash-coach .
#     docker run --rm -it crash-coach
# What a container needs of shared memory for DDS: --shm-size 1g with more than a few robots.
FROM ros:jazzy

RUN apt-get update \
    && apt-get install -y --no-install-recommends build-essential git make python3-venv \
    && rm -rf /var/lib/apt/lists/*

COPY . /crash_coach
WORKDIR /crash_coach
RUN bash -c "source /opt/ros/jazzy/setup.bash && make setup"

# The base image's entry point sources the distribution.
CMD ["bash", "-c", "source ./env.sh && exec bash"]
