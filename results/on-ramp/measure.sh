#!/usr/bin/env bash
# Measures what docs/on-ramp.md says, on seeds that chose nothing. Each JSON file here is the evaluation.json of one
# `unjam drive`, its manifest included. An hour on two cores.
set -eu
cd "$(dirname "$0")/../.."
runs=runs/on-ramp
rm -rf "$runs"
drive() {
    local name=$1 road=$2
    shift 2
    unjam drive "$road" --held-out --episodes 20 --out "$runs/$name" "$@" >/dev/null
    cp "$runs/$name/evaluation.json" "results/on-ramp/$name.json"
}
for share in 05 10 20; do
    people="" # they are the same at every share
    [ $share = 10 ] && people="-d human -d adaptive-acc -d follower-stopper"
    # shellcheck disable=SC2086
    drive "share-$share" on-ramp --cav-share "0.$share" $people -d cruise -d jam-ahead
done
# the same driver, untouched, elsewhere
drive one-lane on-ramp-1 -d human -d jam-ahead
drive late-message on-ramp -d jam-ahead --set roadside.smoothing=60 --set roadside.age=10
drive other-people on-ramp -d human -d jam-ahead --set following=IDM --set time_headways=[1.4,2.0] \
    --set accelerations=[1.8,2.8] --set decelerations=[2.5,3.5] --set gaps=[2.5,3.2] --set inflow=3600
drive no-jam on-ramp -d human -d jam-ahead --set inflow=1800 --set ramp_flow=250
drive tuned-05 on-ramp --cav-share 0.05 -d unjam:on-ramp-tuned
# what longer tuning finds; the last --episodes counts
long=$(python -c "from unjam.training.presets import ON_RAMP_LONG; print(ON_RAMP_LONG)")
drive tuned-long-05 on-ramp --cav-share 0.05 --episodes 40 -d human -d unjam:on-ramp-tuned -d "$long"
# what it is worth when CAVs change lanes otherwise than people; the last --episodes counts
for lanes in keep_right=5 keep_right=0 overtake=5 overtake=0; do
    drive "lanes-$lanes" on-ramp --cav-share 0.05 --episodes 40 -d unjam:on-ramp-tuned --set "cruise.$lanes"
done
# what is learned at 5 % elsewhere, beside its expert and what longer tuning finds
all_three=(-d unjam:on-ramp-tuned -d "$long" -d unjam:on-ramp-best)
drive best-10 on-ramp "${all_three[@]}"
drive best-20 on-ramp --cav-share 0.2 "${all_three[@]}"
drive best-one-lane on-ramp-1 "${all_three[@]}"
drive best-late-message on-ramp "${all_three[@]}" --set roadside.smoothing=60 --set roadside.age=10
drive best-other-people on-ramp "${all_three[@]}" --set following=IDM --set time_headways=[1.4,2.0] \
    --set accelerations=[1.8,2.8] --set decelerations=[2.5,3.5] --set gaps=[2.5,3.2] --set inflow=3600
drive best-no-jam on-ramp "${all_three[@]}" --set inflow=1800 --set ramp_flow=250
