#!/usr/bin/env bash
# Measures what the docs say of experts on the figure eight, the merge, and networks that SUMO carries. Each JSON
# file here is the evaluation.json of one `unjam drive`, its manifest included. Ten minutes.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs
rm -rf "$runs"
for radius in 32 35; do
    unjam drive figure-eight --radius $radius --episodes 10 --out "$runs/figure-eight-$radius" \
        -d human -d pi:time_constant=0 >/dev/null
done
for setting in impatience=0 impatience=1 free_ahead=0 free_ahead=70; do
    unjam drive figure-eight --radius 32 --set $setting --episodes 10 --out "$runs/figure-eight-32-$setting" \
        -d human >/dev/null
done
for radius in 32 33 34 35; do
    unjam drive figure-eight --radius $radius --set horizon=3000 --episodes 10 \
        --out "$runs/figure-eight-steady-$radius" \
        -d human -d pi:time_constant=0 -d pi -d pacer -d pacer:varying=true >/dev/null
done
unjam drive merge --episodes 20 --out "$runs/merge" -d human -d pi:time_constant=0 >/dev/null
unjam drive merge --episodes 20 --set actuation=flow --out "$runs/merge-flow" -d pi:time_constant=0 >/dev/null
unjam drive merge --episodes 10 --set standing=0 --out "$runs/merge-empty" -d human -d pi >/dev/null
mkdir -p runs
rm -rf runs/game && cp -r "$(python -c 'import sumo; print(sumo.SUMO_HOME)')/tools/game" runs/game
for road in ramp A10KW; do
    unjam drive "runs/game/$road.sumocfg" --cav-share 0.1 --episodes 5 --set horizon=1500 --out "$runs/own-$road" \
        -d human -d pi -d acc >/dev/null
done
for road in ring ring-warm ring-jammed figure-eight merge; do
    own="-d pacer"
    # a pacer needs a closed road
    [ $road = merge ] && own="-d jam-absorber -d jam-absorber:gap_gain=0,push=0.9,speed_gain=0.8"
    unjam drive $road --episodes 10 --out "$runs/all-on-$road" \
        -d human -d idm -d pi:time_constant=0 -d pi -d follower-stopper -d acc -d lacc -d bcm -d ovm $own \
        -d constant -d constant:acceleration=0.1 >/dev/null
done
# Tuned experts on the seeds that judge, for tables whose trainings are not kept.
tuned() { unjam drive "$1" --held-out --episodes 20 --out "$runs/tuned-on-$1" -d human "${@:2}" >/dev/null; }
tuned ring -d unjam:ring-tuned -d unjam:ring-gap-tuned
tuned ring-jammed -d pi -d unjam:ring-jammed-tuned
tuned figure-eight -d unjam:figure-eight-tuned
python results/experts/pacer_long.py "$runs/pacer"
cp "$runs/pacer/pacer-long.json" results/experts/ && rm -r "$runs/pacer"
# Copied at the end: until then the tree is as committed, and the manifests say so.
for folder in "$runs"/*; do
    cp "$folder/evaluation.json" "results/experts/$(basename "$folder").json"
done
rm -r "$runs" runs/game
