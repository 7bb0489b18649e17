# A policy on the benchmark: docker build -f docker/evaluate.Dockerfile -t mme-vla-evaluate .
# docker run --gpus all -v <checkpoint>:/checkpoint:ro -v <folder>:/results mme-vla-evaluate
FROM python:3.12.12-slim-trixie

WORKDIR /app
COPY scripts/install_vulkan.sh scripts/install_vulkan.sh
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libgl1 libglib2.0-0 \
    && bash scripts/install_vulkan.sh \
    && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir uv==0.13.9

COPY . .
RUN uv sync --no-cache --no-dev --extra sim

RUN useradd --create-home policy && mkdir /results && chown policy /results
USER policy
ENTRYPOINT [".venv/bin/python", "-m", "mme_vla.evaluate"]
CMD ["checkpoint=/checkpoint", "output=/results/run"]
