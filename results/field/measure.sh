#!/usr/bin/env bash
# Measures all of this folder: results/field/measure.sh NGSIM.parquet ASTAZERO.parquet. Under two hours on two cores.
# The data are not ours to ship; docs/people.md says where they are from and which columns are expected.
set -eu
ngsim=$(realpath "$1") astazero=$(realpath "$2")
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-field
mkdir -p "$runs"
python results/field/field.py "$runs" "$ngsim" "$astazero"
unjam fit-drivers "$ngsim" --driver period,follower --out "$runs/ngsim-drivers.json"
all='own=["desired_speed","time_headway","max_acceleration","comfortable_deceleration","minimum_gap"]'
unjam fit-drivers "$ngsim" --driver period,follower --only split=paper_train --set "$all" --set turns=1 --set calibration.generations=30 \
    --out "$runs/ngsim-drivers-all-own.json"
[ -d "$runs/trained" ] || unjam train ring --preset demo --out "$runs/trained" >/dev/null
python results/field/people_on_ring.py "$runs/ring" "$runs/trained" "$runs"/ngsim-drivers{,-all-own}.json
# Copied at the end: until then the tree is as committed, and the manifests say so.
cp "$runs"/field.{json,png} "$runs"/ngsim-drivers{,-all-own}.json "$runs"/ring/ring.{json,png} results/field/
