# A policy behind a port: docker build -f docker/serve.Dockerfile -t mme-vla-serve .
# docker run --gpus all -p 8001:8001 -v <checkpoint>:/checkpoint:ro -e MME_VLA_API_KEY=<key> mme-vla-serve
# It does not start without a key. In a network of your own: … mme-vla-serve checkpoint=/checkpoint require_key=false
FROM python:3.12.12-slim-trixie

RUN apt-get update \
    && apt-get install -y --no-install-recommends git libgl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir uv==0.13.9

WORKDIR /app
COPY . .
RUN uv sync --no-cache --no-dev --extra serve

RUN useradd --create-home policy
USER policy
EXPOSE 8001
ENTRYPOINT [".venv/bin/python", "-m", "mme_vla.serve", "host=0.0.0.0", "require_key=true"]
CMD ["checkpoint=/checkpoint"]
