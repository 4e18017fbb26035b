#!/usr/bin/env bash
# What docs/calibrate.md says of the motorway ramp that SUMO carries: detectors with a known truth (synthetic.py),
# then one `unjam calibrate`. Some minutes.
set -eu
cd "$(dirname "$0")/../.."
game=$(python3 -c 'import pathlib, sumo; print(pathlib.Path(sumo.SUMO_HOME) / "tools" / "game")')
mkdir -p runs
cp -r "$game/ramp" "$game/ramp.sumocfg" "$game/input_additional.add.xml" runs
rm -rf runs/calibrate-ramp
python3 results/calibrate/synthetic.py runs/ramp.sumocfg results/calibrate/detectors.csv \
    results/calibrate/true.json
unjam calibrate runs/ramp.sumocfg --detectors results/calibrate/detectors.csv --out runs/calibrate-ramp
cp runs/calibrate-ramp/calibration.json results/calibrate/ramp.json
