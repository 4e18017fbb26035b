#!/usr/bin/env bash
# What docs/calibrate.md says of the motorway ramp that SUMO carries: detectors with a known truth (synthetic.py),
# then one `unjam calibrate`, and how near all come to another day. Some minutes.
set -eu
cd "$(dirname "$0")/../.."
game=$(python3 -c 'import pathlib, sumo; print(pathlib.Path(sumo.SUMO_HOME) / "tools" / "game")')
mkdir -p runs
cp -r "$game/ramp" "$game/ramp.sumocfg" "$game/input_additional.add.xml" runs
here=results/calibrate
rm -rf runs/calibrate-ramp runs/ramp-true
python3 $here/synthetic.py runs/ramp.sumocfg runs/ramp-true $here/detectors.csv $here/another-day.csv
unjam calibrate runs/ramp.sumocfg --detectors $here/detectors.csv --out runs/calibrate-ramp
cp runs/calibrate-ramp/calibration.json $here/ramp.json
python3 $here/judge.py $here/days.json runs/ramp-true/factors.json $here/detectors.csv $here/another-day.csv \
    original=runs/ramp.sumocfg calibrated=runs/calibrate-ramp/calibrated.sumocfg true=runs/ramp-true/true.sumocfg
