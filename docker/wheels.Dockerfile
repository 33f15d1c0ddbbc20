# Without a ROS installation, by pip wheels: docker build -f docker/wheels.Dockerfile -t segfloor-wheels .
# docker run -v $PWD:/data segfloor-wheels run /data/drive --out /data/result --report
FROM python:3.12-slim
RUN apt-get update \
 && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri libopengl0 \
 && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir -c /src/constraints.txt '/src[all]'
ENV MUJOCO_GL=egl
ENTRYPOINT ["segfloor"]
