#!/usr/bin/env bash
# Measures what docs/virtual.md says of knowledge where whole roads are imagined. About half an hour on one core.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-whole-roads
rm -rf "$runs"
python results/model/whole_roads.py "$runs"
# Copied at the end: until then the tree is as committed, and the manifest says so.
cp "$runs"/whole_roads.json results/model/
rm -r "$runs"
