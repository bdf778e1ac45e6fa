# svu_mi on the CPU, with its viewer:
#   docker build -t svu_mi .
#   docker run --rm --user "$(id -u)" -v "$PWD:/work" svu_mi demo
#   docker run --rm --user "$(id -u)" -v "$PWD:/work" svu_mi entropy capture -o out/entropy
FROM python:3.11-slim
COPY pyproject.toml README.md LICENSE /src/
COPY svu_mi /src/svu_mi
COPY plugins /src/plugins
COPY scenes /src/scenes
RUN pip install --no-cache-dir '/src[viewer]' && rm -r /src
# Compiled kernels and fonts are cached in HOME, which any user may write.
ENV HOME=/tmp
WORKDIR /work
ENTRYPOINT ["svu"]
CMD ["demo"]
