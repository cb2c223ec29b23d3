# The needletrack daemon.
#   docker build --tag needletrack .
#   docker run --network host --volume "$PWD/recordings:/recordings:ro" needletrack \
#       replay /recordings/steer-b --paced --loop 100 --publish tcp/127.0.0.1:7447
FROM python:3.11-slim-bookworm AS build

# The kernels are compiled here; the image that runs has no compiler.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*

# The pinned packages change seldom and keep a layer of their own.
WORKDIR /build
COPY requirements/build.lock requirements/runtime.lock ./
RUN pip install --no-cache-dir --no-deps --require-hashes -r build.lock \
    && python -m venv /opt/needletrack \
    && /opt/needletrack/bin/pip install --no-cache-dir --no-deps --require-hashes -r runtime.lock

COPY pyproject.toml hatch_build.py README.md LICENSE NOTICE ./
COPY src ./src
RUN python -m hatchling build --target wheel --directory dist \
    && /opt/needletrack/bin/pip install --no-cache-dir --no-deps --no-index dist/*.whl

FROM python:3.11-slim-bookworm

# Members of group video may open /dev/video*.
RUN useradd --create-home --uid 10001 --groups video needletrack
COPY --from=build /opt/needletrack /opt/needletrack

# One thread for BLAS and OpenMP: the stages are small, and more threads add jitter instead of speed.
ENV PATH=/opt/needletrack/bin:$PATH \
    MPLBACKEND=Agg \
    OMP_NUM_THREADS=1 \
    PYTHONUNBUFFERED=1

USER 10001
WORKDIR /home/needletrack
# The daemon ends its loop and says goodbye on an interrupt.
STOPSIGNAL SIGINT
ENTRYPOINT ["needletrack"]
CMD ["--help"]
