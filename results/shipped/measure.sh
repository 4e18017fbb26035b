#!/usr/bin/env bash
# Drives the ring's shipped controller where it was not trained: on warm and jammed rings, beside experts, on seeds
# that no training has. Five minutes. Each JSON file is the evaluation.json of one `unjam drive`.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-shipped
rm -rf "$runs"
for road in ring-warm ring-jammed; do
    unjam drive $road --episodes 20 --seed 1000000 --out "$runs/$road" \
        -d human -d pi -d pi:time_constant=0 -d follower-stopper -d unjam:ring-best >/dev/null
done
# Copied at the end: until then the tree is as committed, and the manifests say so.
for folder in "$runs"/*; do
    cp "$folder/evaluation.json" "results/shipped/$(basename "$folder").json"
done
rm -r "$runs"
