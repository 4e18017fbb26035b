# unjam with all extras but marl and ray, on the CPU. Written for, and not yet tried on, a machine with Docker:
#   docker build -t unjam . && docker run --rm -v "$PWD/runs:/data/runs" unjam drive ring -d human -d pi
FROM python:3.11-slim
COPY . /source
# netconvert and libsumo are linked against libraries of X that the slim image lacks
RUN apt-get update && apt-get install -y --no-install-recommends libgl1 libxrender1 libxcursor1 libxfixes3 \
        libxinerama1 libxrandr2 libxft2 libglu1-mesa libgomp1 libatomic1 \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir -c /source/constraints.txt "/source[sign,train,tune,video]" \
        --extra-index-url https://download.pytorch.org/whl/cpu \
    && rm -rf /source
WORKDIR /data
ENTRYPOINT ["unjam"]
CMD ["--help"]
