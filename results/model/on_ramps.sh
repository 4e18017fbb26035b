#!/usr/bin/env bash
# Measures what docs/virtual.md says of knowledge where on-ramps are imagined. About an hour on one core.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-on-ramps
rm -rf "$runs"
python results/model/on_ramps.py "$runs"
# Copied at the end: until then the tree is as committed, and the manifest says so.
cp "$runs"/on_ramps.json results/model/
rm -r "$runs"
