# Not tried: there is no container engine and no registry where this was written.
# The nodes beside an arm, on apt's ROS:
#     docker build -t push_ident .
#     docker run --rm -it --network host --ipc host push_ident push-ident up sim
FROM ros:jazzy AS build
RUN apt-get update && apt-get install -y --no-install-recommends build-essential cmake git python3-dev python3-pip python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY . /push_ident
WORKDIR /push_ident
SHELL ["/bin/bash", "-c"]
RUN . /opt/ros/jazzy/setup.bash && make setup && rm -rf /root/.cache

FROM ros:jazzy
RUN apt-get update && apt-get install -y --no-install-recommends gcc && rm -rf /var/lib/apt/lists/*
COPY --from=build /push_ident /push_ident
WORKDIR /push_ident
ENV PATH=/push_ident/.venv/bin:$PATH
CMD ["push-ident", "doctor"]
