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
own() { unjam fit-drivers "$1" --set "$all" --set turns=1 --set calibration.generations=30 --out "$runs/$2.json" "${@:3}"; }
own "$ngsim" ngsim --driver period,follower --only split=paper_train
# Only people: the other cars of AstaZero drove by their ACC.
python -c 'import sys, pandas; rows = pandas.read_parquet(sys.argv[1]); rows[~rows.acc.astype(bool)].to_parquet(sys.argv[2])' \
    "$astazero" "$runs/astazero-human.parquet"
own "$runs/astazero-human.parquet" astazero --driver run,follower
[ -d "$runs/trained" ] || unjam train ring --preset demo --out "$runs/trained" >/dev/null
python results/field/people_on_ring.py "$runs/ring" "$runs/trained" "$runs"/{ngsim-drivers,ngsim}.json
# Copied at the end: until then the tree is as committed, and the manifests say so.
cp "$runs"/field.{json,png} "$runs"/ngsim-drivers.json "$runs"/ring/ring.{json,png} results/field/
cp "$runs"/{ngsim,astazero}.json src/unjam/scenarios/people/
