# The service with its networks: no compiler, no torch, not root.
#   docker build -t quadlift . && docker run -p 8000:8000 quadlift
# Faster on x86-64, and 180 MB larger: docker build --build-arg EXTRAS=openvino -t quadlift .

FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY service service
COPY clients clients
COPY models_export models_export
COPY benchmarks benchmarks
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .
ARG EXTRAS=
RUN python -m venv /opt/quadlift \
 && /opt/quadlift/bin/pip install --no-cache-dir "$(echo /wheels/quadlift-*.whl)${EXTRAS:+[$EXTRAS]}" \
 && /opt/quadlift/bin/python -c "import importlib.util as u; assert u.find_spec('torch') is None, 'torch came in'"

FROM python:3.11-slim
RUN useradd --system --uid 10001 --no-create-home quadlift \
 && install -d -o quadlift -g quadlift /data
COPY --from=build /opt/quadlift /opt/quadlift
ENV PATH=/opt/quadlift/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    QUADLIFT_HOST=0.0.0.0 \
    QUADLIFT_PORT=8000 \
    QUADLIFT_DATA_DIR=/data
WORKDIR /data
USER quadlift
VOLUME /data
EXPOSE 8000
# Ready only when the networks are warm; any other answer raises, which ends with status 1.
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
  CMD ["python", "-c", "import os, urllib.request as u; u.urlopen(f\"http://127.0.0.1:{os.environ['QUADLIFT_PORT']}/health/ready\", timeout=4)"]
CMD ["quadlift", "serve"]
