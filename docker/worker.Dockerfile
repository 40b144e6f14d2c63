# The queue worker and the renderer. Build from the repository's root:
#   docker build -f docker/worker.Dockerfile -t splatmill-worker .
# PIP_ARGS chooses another build of torch (a CPU-only or a CUDA one) by pip's own options.
FROM debian:bookworm-slim AS build
ARG PIP_ARGS=""
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ca-certificates g++ make \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY constraints.txt ./
# The heavy wheels first: they change rarely, the code below often.
RUN pip install -q -c constraints.txt -U pip && pip install -q $PIP_ARGS -c constraints.txt torch pycolmap matplotlib av
COPY client client
COPY worker worker
RUN pip install -q $PIP_ARGS -c constraints.txt ./client ./worker

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 ca-certificates libgomp1 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --create-home splatmill \
    && install -d -o splatmill -g splatmill /data
COPY --from=build /opt/splatmill /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PYTHONUNBUFFERED=1 SPLATMILL_DATA=/data SPLATMILL_STORAGE=file:///data/storage
USER splatmill
CMD ["python", "-m", "splatmill_worker", "train"]
