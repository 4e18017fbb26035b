#!/usr/bin/env bash
# What docs/assess.md says of the motorway ramp that SUMO carries: the assessment.json of one `unjam assess`. Some
# minutes.
set -eu
cd "$(dirname "$0")/../.."
game=$(python3 -c 'import pathlib, sumo; print(pathlib.Path(sumo.SUMO_HOME) / "tools" / "game")')
mkdir -p runs
cp -r "$game/ramp" "$game/ramp.sumocfg" "$game/input_additional.add.xml" runs
rm -rf runs/assess-ramp runs/ramp-acc
unjam assess runs/ramp.sumocfg --shares 0.05,0.2 --episodes 130 --out runs/assess-ramp
cp runs/assess-ramp/assessment.json results/assess/ramp.json
# An ACC that follows as closely as people there want to, beside people alone
unjam drive runs/ramp.sumocfg -d human -d cruise --cav-share 0.1 --end 700 -n 6 --set actuation=cruise \
  --set safety.active=false --set cruise.time_headway=1 --out runs/ramp-acc
cp runs/ramp-acc/evaluation.json results/assess/ramp-acc.json
