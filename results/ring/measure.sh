#!/usr/bin/env bash
# Measures what docs/ring.md says of the ring: drivers that do not learn, on the actual simulator.
# Each JSON file here is the evaluation.json of one `unjam drive`, its manifest included. About five minutes.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/for-the-docs
rm -rf "$runs"
measure() {  # name of the file, then the arguments of unjam drive
    name=$1; shift
    unjam drive "$@" --out "$runs/$name" >/dev/null
}
for length in 220 230 240 250 260 270; do
    measure "ring-warm-$length" ring-warm --length $length --episodes 10 \
        -d human -d pi:time_constant=0 -d pi -d follower-stopper
done
measure ring ring --episodes 20 -d human -d pi:time_constant=0 -d pi -d follower-stopper -d idm
measure ring-jammed ring-jammed --episodes 20 -d human -d idm -d pi:time_constant=0 -d pi -d follower-stopper
measure ring-jammed-unfiltered ring-jammed --set safety.active=false --episodes 20 -d pi:time_constant=0 -d pi
measure ring-5 ring-warm --vehicles 5 --length 55 --episodes 5 -d human -d pi
measure ring-11 ring-warm --vehicles 11 --length 115 --episodes 5 -d human -d pi
measure ring-44 ring-warm --vehicles 44 --length 520 --episodes 5 -d human -d pi
# Copied at the end: until then the tree is as committed, and the manifests say so.
for folder in "$runs"/*; do
    cp "$folder/evaluation.json" "results/ring/$(basename "$folder").json"
done
rm -r "$runs"
