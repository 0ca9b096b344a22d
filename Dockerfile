# An image with the command `zlocus`, run by a user without rights. Any base with Python 3.11 or newer and its venv module:
# buildah build --build-arg BASE=python:3.12-slim --tag zlocus .
ARG BASE=python:3.12-slim
FROM ${BASE}

COPY pyproject.toml README.md LICENSE /opt/source/
COPY src /opt/source/src
RUN python3 -m venv /opt/zlocus \
    && /opt/zlocus/bin/pip install --no-cache-dir --prefer-binary '/opt/source[cluster,inspect,xarray]' \
    && rm -r /opt/source \
    && useradd --create-home --uid 10001 zlocus \
    && install -d -o zlocus /work

ENV PATH=/opt/zlocus/bin:$PATH
USER 10001
# Compiled kernels are kept in the user's home, so that no run compiles them again. KERNELS=no leaves them to the first run.
ARG KERNELS=yes
RUN if [ "$KERNELS" = yes ]; then \
        for group in orient match refine; do python -m zlocus.pipeline.execution.precompile "$group" || exit; done; \
    fi
WORKDIR /work
ENTRYPOINT ["zlocus"]
CMD ["--help"]
