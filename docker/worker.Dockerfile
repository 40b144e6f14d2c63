# The queue worker and the renderer. Build it in the root folder of the repository:
#   docker build -f docker/worker.Dockerfile -t splatmill-worker .
# PIP_ARGS: options of pip that choose another build of torch, such as the CPU-only one.
# GPU_PACKAGES: set it to "gcc libc6-dev python3-dev" to train on a GPU, because Triton compiles C code at run time.
FROM debian:bookworm-20260918-slim@sha256:3783cc01769c7b2b1b83a5c5ad96c815348e28ed7da68e2e3687004faa906251 AS build
ARG PIP_ARGS=""
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ca-certificates g++ make \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY constraints.txt ./
# The large wheels first: they change rarely, so that a change of the code leaves this layer as it is.
RUN pip install -q -c constraints.txt -U pip && pip install -q $PIP_ARGS -c constraints.txt torch pycolmap opencv-python-headless matplotlib av
COPY client client
COPY worker worker
RUN pip install -q $PIP_ARGS -c constraints.txt ./client ./worker

FROM debian:bookworm-20260918-slim@sha256:3783cc01769c7b2b1b83a5c5ad96c815348e28ed7da68e2e3687004faa906251
ARG GPU_PACKAGES=""
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 ca-certificates libgomp1 $GPU_PACKAGES \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --create-home splatmill \
    && install -d -m 0700 -o splatmill -g splatmill /data /data/storage /data/storage/models
COPY --from=build /opt/splatmill /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PYTHONUNBUFFERED=1 SPLATMILL_DATA=/data SPLATMILL_STORAGE=file:///data/storage
USER splatmill
CMD ["python", "-m", "splatmill_worker", "train"]
