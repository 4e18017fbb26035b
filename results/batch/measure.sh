#!/usr/bin/env bash
# Measures what docs/virtual.md says of batches of rings: how far they are from SUMO's episodes of the same seeds
# (parity.json), and how fast they are beside it, on one core (bench.json); the same of figures eight, and how far
# one step of them is from SUMO's; and of on-ramps. About forty minutes.
set -eu
cd "$(dirname "$0")"
python parity.py > parity.json
unjam bench --json --rounds 5 > bench.json
python parity-eight.py > parity-eight.json
PYTHONPATH=../.. python one-step-eight.py > one-step-eight.json
python parity-on-ramp.py > parity-on-ramp.json
unjam bench --device cpu --json > sizes-cpu.json
# where there is a graphics card, which needs a torch that knows it: unjam bench --device cuda --json > sizes-gpu.json
