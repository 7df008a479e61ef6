# Trains in a container, with PyTorch's CPU build:
#
#   docker build --tag mo-deepdrive .
#   docker run --rm --volume mo-deepdrive-compiled:/tmp/numba --volume "$PWD/runs:/work/runs" mo-deepdrive --config one_waypoint/mo_a2c_linear
#
# Other commands: docker run --rm --entrypoint mo-deepdrive mo-deepdrive zoo
FROM python:3.13-slim AS build
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir --constraint constraints.txt build && python -m build --wheel --outdir /dist

FROM python:3.13-slim
# Compiled code and fonts are cached here, for any user.
ENV NUMBA_CACHE_DIR=/tmp/numba MPLCONFIGDIR=/tmp/matplotlib
COPY --from=build /dist /source/constraints.txt /tmp/dist/
RUN pip install --no-cache-dir --constraint /tmp/dist/constraints.txt \
        --extra-index-url https://download.pytorch.org/whl/cpu "$(ls /tmp/dist/*.whl)[train]" \
    && rm -r /tmp/dist
WORKDIR /work
ENTRYPOINT ["mo-deepdrive", "train"]
CMD ["--help"]
