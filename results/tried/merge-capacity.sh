#!/usr/bin/env bash
# How much traffic the merge carries when people drive alone, from an empty road and from the standing start. Two
# minutes. Each JSON file is the evaluation.json of one `unjam drive`.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-capacity
rm -rf "$runs"
for standing in 0 5; do
    for inflow in 1600 1800 1900 2000 2100 2200; do
        unjam drive merge -d human --set standing=$standing --set inflow=$inflow --episodes 10 --seed 1000000 \
            --out "$runs/$standing-$inflow" >/dev/null
    done
done
# Copied at the end: until then the tree is as committed, and the manifests say so.
mkdir -p results/tried/merge-capacity
for folder in "$runs"/*; do
    cp "$folder/evaluation.json" "results/tried/merge-capacity/$(basename "$folder").json"
done
rm -r "$runs"
