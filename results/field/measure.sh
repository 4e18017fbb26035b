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
[ -d "$runs/trained" ] || unjam train ring --preset demo --out "$runs/trained" >/dev/null
python results/field/people_on_ring.py "$runs/ring" "$runs/ngsim-drivers.json" "$runs/trained"
# Copied at the end: until then the tree is as committed, and the manifests say so.
cp "$runs"/field.{json,png} "$runs"/ngsim-drivers.json "$runs"/ring/ring.{json,png} results/field/
