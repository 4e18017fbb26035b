#!/usr/bin/env bash
# What closing up is worth to the jam absorber: each setting on the same 20 seeds, which neither train nor judge. Two
# minutes. The JSON file is the evaluation.json of one `unjam drive`.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-closing
rm -rf "$runs"
unjam drive merge --episodes 20 --seed 600 --out "$runs" -d human \
    -d jam-absorber \
    -d jam-absorber:time_gap=0.2,gap_gain=0.05 \
    -d jam-absorber:gap_gain=0,push=0.9,speed_gain=0.5 \
    -d jam-absorber:gap_gain=0,push=0.9,speed_gain=0.8 \
    -d jam-absorber:gap_gain=0,push=0.9,speed_gain=1.2 \
    -d jam-absorber:gap_gain=0,push=0.9,speed_gain=0.8,jam_speed=0 >/dev/null
# Copied at the end: until then the tree is as committed, and the manifest says so.
cp "$runs/evaluation.json" results/tried/merge-closing.json
rm -r "$runs"
