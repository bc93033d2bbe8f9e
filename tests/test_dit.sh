#!/usr/bin/env bash
# test_dit.sh GSFIX MAKE_MODEL SCENE SCRATCH: gsfix with the restorer dit, on a small model with random weights: a clip and a
# scene are restored, interrupted, killed and resumed with the same bytes. Stops at the first failure with a line and exit 1.
set -euo pipefail
gsfix=$1 make_model=$2 scene=$3 scratch=$4
[ -x "$gsfix" ] && [ -x "$make_model" ] && [ -d "$scene" ] || { echo "SKIPPED: no programs or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
export OMP_WAIT_POLICY=passive
log=$scratch/log
fail() { echo "$0: $*"; tail -n 5 "$log"; exit 1; }
"$make_model" "$scratch/all" --size tiny > "$log" 2>&1 || fail "make_model failed"
mkdir "$scratch/model" # the same model without encoders
for part in transformer vae scheduler; do ln -s "../all/$part" "$scratch/model/$part"; done
from_photos=(--restorer "dit:$scratch/all")
saved=$scratch/saved.safetensors
dit=(--restorer "dit:$scratch/model" --ref-features "$saved")
options=(--views 3 --iterations 60 --checkpoint-every 5 --max-size 64 --seed 7 --steps 4
    --set "rounds=1,windows=3,first_round=20,last_round=40")
fix() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" fix "$scene" --out "$out" "${options[@]}" "$@" > "$log" 2>&1
}

# Three clips, each with its own caption and photos, first with the model's encoders, then with the features saved from them.
fix "$scratch/whole" "${from_photos[@]}" --save-features "$saved" --threads 2 || fail "the run from photos failed"
[ ! -e "$scratch/whole/dit.checkpoint" ] || fail "the clip's checkpoint is left behind"
grep -q '"solver": *"ddim"' "$scratch/whole/metrics.json" || fail "metrics.json does not tell the solver"
grep -q '"window_frames": *9' "$scratch/whole/metrics.json" || fail "windows are not as long as the model was trained on"
for stage in caption text dinov2 vggt "vae encode" transformer "vae decode"; do
    grep -q "\"name\": *\"$stage\"" "$scratch/whole/metrics.json" || fail "metrics.json does not tell of the stage $stage"
done
for clip in 0 1 2; do grep -q "prompt_embeds.clip$clip" "$saved" || fail "the prompt of clip $clip is not saved"; done
fix "$scratch/one" "${dit[@]}" --threads 1 || fail "the saved features do not do"
cmp "$scratch/whole/splats.ply" "$scratch/one/splats.ply" || fail "saved features, or one worker, give something else"
! grep -q '"name": *"caption"' "$scratch/one/metrics.json" || fail "the captioner ran although prompts were given"

kills=0
kill_clips() { # OUT TIMES OPTION...: kill -9 as soon as a clip has started, then a final run to the end
    local out=$1 left=$2 pid
    shift 2
    while [ "$left" -gt 0 ]; do
        rm -f "$out/dit.checkpoint"
        "$gsfix" fix "$scene" --out "$out" "${options[@]}" "$@" --resume > "$log" 2>&1 &
        pid=$!
        while kill -0 "$pid" 2> /dev/null && [ ! -e "$out/dit.checkpoint" ]; do sleep 0.01; done
        kill -9 "$pid" 2> /dev/null || true
        wait "$pid" 2> /dev/null && break # it finished before the kill
        kills=$((kills + 1)) left=$((left - 1))
    done
    fix "$out" "$@" --resume || fail "the last run failed after $kills kills"
}
kill_clips "$scratch/killed" 3 "${dit[@]}"
cmp "$scratch/whole/splats.ply" "$scratch/killed/splats.ply" || fail "differs after $kills kills"
kill_clips "$scratch/photos_killed" 1 "${from_photos[@]}" --save-features "$scratch/again.safetensors"
cmp "$scratch/whole/splats.ply" "$scratch/photos_killed/splats.ply" || fail "from photos: differs after a kill"
cmp "$saved" "$scratch/again.safetensors" || fail "other features are saved after a kill"

# One clip: the frames of the scene's first window, from a folder of images, with a feature file for this clip only.
dit=(--restorer "dit:$scratch/model" --ref-features "$scratch/all/features.safetensors")
mkdir -p "$scratch/clip"
for frame in "$scratch"/whole/fixed/*window1*.png; do cp "$frame" "$scratch/clip/"; done
restore() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" restore "$scratch/clip" --out "$out" "${dit[@]}" --steps 40 "$@" > "$log" 2>&1
}
restore "$scratch/restored" || fail "restore failed"
# No room for the clip's checkpoint (a file size limit simulates a full disk): the clip is restored nevertheless.
largest=$(stat -c %s "$scratch"/restored/*.png "$scratch"/restored/confidence/*.png | sort -n | tail -n 1)
(ulimit -f $((largest / 1024 + 2)); restore "$scratch/full") || fail "restore failed for want of a checkpoint"
[ "$(grep -c "warning: going on without the clip's checkpoint" "$log")" = 1 ] || fail "not one warning"
for frame in "$scratch"/restored/*.png; do cmp "$frame" "${frame/restored/full}" || fail "frames differ without a checkpoint"; done
"$gsfix" restore "$scratch/clip" --out "$scratch/stopped" "${dit[@]}" --steps 40 > "$log" 2>&1 &
pid=$!
while kill -0 "$pid" 2> /dev/null && [ ! -e "$scratch/stopped/dit.checkpoint" ]; do sleep 0.01; done
kill -INT "$pid" 2> /dev/null || true
wait "$pid" 2> /dev/null || true
restore "$scratch/stopped" || fail "restore failed after it was stopped"
for frame in "$scratch"/restored/*.png; do cmp "$frame" "${frame/restored/stopped}" || fail "frames differ after a stop"; done
for condition in none 2d 3d; do
    restore "$scratch/$condition" --condition "$condition" || fail "--condition $condition failed"
    ! cmp -s "$scratch/$condition/$(basename "$frame")" "$frame" || fail "--condition $condition changes nothing"
done
# --bf16 rounds the products of all three encoders where the processor has fast instructions for that, and nothing elsewhere.
isa=$(sed -n 's/.*"isa": *"\([a-z0-9_]*\)".*/\1/p' "$scratch/whole/metrics.json" | head -n 1)
[ -n "$isa" ] || fail "metrics.json does not tell the instruction set"
dit=()
for condition in none 2d 3d; do # the prompts alone, then with either encoder of photos
    given=(--caption "a wall" --restorer "dit:$scratch/all")
    [ "$condition" = none ] || given+=(--ref-features "$scratch/none.safetensors")
    frames=("$scratch"/clip/*)
    given+=(--condition "$condition" --refs "${frames[0]},${frames[-1]}" --steps 1)
    restore "$scratch/exact_$condition" "${given[@]}" --save-features "$scratch/$condition.safetensors" ||
        fail "features of --condition $condition are not saved"
    restore "$scratch/low_$condition" "${given[@]}" --save-features "$scratch/low_$condition.safetensors" --bf16 || fail "--bf16 failed"
    same=0
    ! cmp -s "$scratch/$condition.safetensors" "$scratch/low_$condition.safetensors" || same=1
    case $isa in avx512_bf16|amx) wanted=0;; *) wanted=1;; esac
    [ "$same" = "$wanted" ] || fail "features of --condition $condition by --bf16 on $isa: same $same"
done
dit=(--restorer "dit:$scratch/model" --ref-features "$scratch/all/features.safetensors")
restore "$scratch/fast" --steps 8 --solver unipc --guidance-until 0.5 --strength 0.5 --block-cache 0.1 --int8 --bf16 ||
    fail "the options that save steps failed"

expect() { # STATUS TEXT COMMAND...
    local status=$1 text=$2 got=0
    shift 2
    "$@" > "$log" 2>&1 || got=$?
    [ "$got" = "$status" ] || fail "exit status $got, not $status: $*"
    grep -q -- "$text" "$log" || fail "does not say \"$text\": $*"
}
expect 1 "; not needed with " "$gsfix" restore "$scratch/clip" --out "$scratch/x" --restorer "dit:$scratch/model"
expect 2 "--solver" "$gsfix" restore "$scratch/clip" --out "$scratch/x" --restorer warp --solver ddim
expect 1 "config.json" "$gsfix" restore "$scratch/clip" --out "$scratch/x" "${dit[@]}" --restorer "dit:$scratch/none"
head -c 1000 "$scratch/all/features.safetensors" > "$scratch/cut.safetensors"
expect 1 "cut.safetensors" "$gsfix" restore "$scratch/clip" --out "$scratch/x" "${dit[@]}" \
    --ref-features "$scratch/cut.safetensors"


# Any number and size of frames: more and fewer than the 9 frames of 96 x 64 that the model was trained for.
size() { od -An -tx1 -j16 -N8 "$1"; } # of a PNG
expect 0 "" "$gsfix" render "$scratch/whole/splats.ply" --scene "$scene" --max-size 50 --out "$scratch/views"
views=("$scratch"/views/*.png)
for count in 1 5 21; do
    mkdir -p "$scratch/clip$count"
    for i in $(seq -w "$count"); do cp "${views[10#$i % ${#views[@]}]}" "$scratch/clip$count/$i.png"; done
    expect 0 "restored by" "$gsfix" restore "$scratch/clip$count" --out "$scratch/back$count" "${dit[@]}" --steps 2
    [ "$(ls "$scratch/back$count"/*.png | wc -l)" = "$count" ] || fail "not $count frames came back"
    [ ! -e "$scratch/back$count/dit.checkpoint" ] && [ ! -e "$scratch/back$count/dit.checkpoint.1" ] ||
        fail "checkpoints are left behind"
done
[ "$(size "$scratch/back5/1.png")" = "$(size "$scratch/clip5/1.png")" ] || fail "frames of another size came back"
# Interrupted in the last part of a long clip: completed parts are not sampled again.
"$gsfix" restore "$scratch/clip21" --out "$scratch/long" "${dit[@]}" --steps 2 > "$log" 2>&1 &
pid=$!
while kill -0 "$pid" 2> /dev/null && [ ! -e "$scratch/long/dit.checkpoint.2" ]; do sleep 0.01; done
kill -9 "$pid" 2> /dev/null || true
wait "$pid" 2> /dev/null || true
expect 0 "restored by" "$gsfix" restore "$scratch/clip21" --out "$scratch/long" "${dit[@]}" --steps 2
for frame in "$scratch"/back21/*.png; do cmp "$frame" "${frame/back21/long}" || fail "a long clip differs after a kill"; done

# The error names missing features of a clip; window lengths other than the trained one must be requested.
expect 1 "prompt_embeds.clip3" "$gsfix" fix "$scene" --out "$scratch/x" "${options[@]}" --ref-features "$saved" \
    --restorer "dit:$scratch/model" --set "rounds=2,windows=3,first_round=20,last_round=40"
expect 1 "prompt_embeds.clip1" "$gsfix" fix "$scene" --out "$scratch/bare" "${options[@]}" "${dit[@]}"
expect 0 "the restorer takes 9 instead" "$gsfix" fix "$scene" --out "$scratch/y" "${options[@]}" "${from_photos[@]}" \
    --condition none --caption "a wall" --steps 1 --set "rounds=1,windows=1,window_frames=17,first_round=20,last_round=40"
# gsfix evaluate compares conditions on restored sequences, in the paper's order.
"$gsfix" evaluate "$scene" --out "$scratch/evaluate" --views 3 --restorers "dit:$scratch/all" --conditions both,2d --steps 1 \
    --iterations 10 --max-size 48 --frames 3 --threads 1 --tables conditions > "$log" 2>&1 || fail "evaluate failed"
[ "$(sed -n 's/^| \(dit [^|]*\) | tracks .*/\1/p' "$scratch/evaluate/tables.md" | tr '\n' ';')" = "dit w/o 3D tokens;dit full model;" ] ||
    fail "the rows of the conditions"

echo "$kills kills"
