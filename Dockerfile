# NerfDiff in a container, with what the demo and the commands need. Not tried by its authors: no Docker was at hand.
#   docker build -t nerfdiff .                                   for CPUs
#   docker build -t nerfdiff:cuda --build-arg TORCH=cuda .       for NVIDIA GPUs (the wheels bring CUDA)
#   docker run --rm -v "$PWD/runs:/nerfdiff/runs" nerfdiff       the demo; add --gpus all for the second
#   docker run --rm -v "$PWD:/pictures" nerfdiff python src/picture.py /pictures/car.jpg out=/pictures/out
FROM python:3.11-slim

# cpu or cuda: which build of PyTorch `make setup` installs
ARG TORCH=cpu

RUN apt-get update && apt-get install -y --no-install-recommends make g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /nerfdiff

# what is installed changes seldom: a layer of its own
COPY pyproject.toml setup.py MANIFEST.in LICENSE README.md requirements.lock Makefile ./
COPY src/nerfdiff/__init__.py src/nerfdiff/__init__.py
RUN make setup PYTHON=python3 TORCH=${TORCH}

COPY assets assets
COPY conf conf
COPY src src

ENV PATH="/nerfdiff/.venv/bin:$PATH"
EXPOSE 6006 8080
CMD ["make", "demo", "PYTHON=python3"]
