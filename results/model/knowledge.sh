#!/usr/bin/env bash
# Measures what docs/virtual.md says of knowledge: IDM alone, IDM plus residual networks, networks alone. About half
# an hour on one core.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs-knowledge
rm -rf "$runs"
python results/model/knowledge.py "$runs"
# Copied at the end: until then the tree is as committed, and the manifest says so.
cp "$runs"/knowledge.{json,png} results/model/
rm -r "$runs"
