#!/usr/bin/env bash
# Measures what docs/virtual.md says of knowledge where whole roads are imagined. About an hour and a half on one
# core, an hour of it on on-ramps.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-whole-roads
rm -rf "$runs"
python results/model/whole_roads.py "$runs"
python results/model/on_ramps.py "$runs"
# Copied at the end: until then the tree is as committed, and the manifest says so.
cp "$runs"/whole_roads.json "$runs"/on_ramps.json results/model/
rm -r "$runs"
