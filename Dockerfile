# CPU:         docker build -t radejax .
# NVIDIA GPU:  docker build -t radejax --build-arg PACKAGE='.[cuda]' .
#              docker run --rm --gpus all -v /disk1/kradar:/data -v "$PWD/runs:/radejax/runs" radejax \
#                  python train.py --config configs/radenet.py --data /data
# JAX's wheels bring CUDA with them: the host needs only its driver.
FROM python:3.12-slim
ARG PACKAGE=.
WORKDIR /radejax
COPY . .
RUN pip install --no-cache-dir -e "${PACKAGE}"
CMD ["radejax", "--help"]
