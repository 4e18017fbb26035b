#!/usr/bin/env bash
# Trains on the ring with the virtual environment (that is the demo) and without it, five seeds each; the curves are
# in the docs. Half an hour on two cores. Each folder gets the progress and the judgement of one `unjam train`.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-model
train() { # name, seed, settings
    name=$1 seed=$2
    shift 2
    unjam train ring --steps 300000 --seed "$seed" --workers 1 --out "$runs/$name-$seed" --set evaluation.every=2 "$@" \
        >/dev/null
}
export -f train
export runs
rm -rf "$runs"
for seed in 0 1 2 3 4; do
    train with "$seed" &
    train without "$seed" --set virtual.virtual_ratio=0
    wait
done
# Copied at the end: until then the tree is as committed, and the manifests say so.
for folder in "$runs"/*; do
    target=results/model/curves/$(basename "$folder")
    mkdir -p "$target"
    cp "$folder/progress.jsonl" "$folder/config.toml" "$folder/manifest.json" "$target"
    python -c "import json, sys; d = json.load(open(sys.argv[1])); d.pop('shown'); json.dump(d, open(sys.argv[2], 'w'))" \
        "$folder/evaluation.json" "$target/evaluation.json"
done
rm -r "$runs"
