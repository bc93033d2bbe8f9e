#!/usr/bin/env bash
# test_dit.sh GSFIX MAKE_MODEL SCENE SCRATCH: the restorer dit through the program, on a small model of random weights: a
# clip and a scene are restored, stopped, killed and resumed to the same bytes. Exit status 1 and a line on the first fault.
set -euo pipefail
gsfix=$1 make_model=$2 scene=$3 scratch=$4
[ -x "$gsfix" ] && [ -x "$make_model" ] && [ -d "$scene" ] || { echo "SKIPPED: no programs or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
export OMP_WAIT_POLICY=passive
log=$scratch/log
fail() { echo "$0: $*"; tail -n 5 "$log"; exit 1; }
"$make_model" "$scratch/model" --size tiny --parts transformer,vae,scheduler,features > "$log" 2>&1 ||
    fail "make_model failed"
dit=(--restorer "dit:$scratch/model" --ref-features "$scratch/model/features.safetensors")
options=(--views 3 --iterations 60 --checkpoint-every 5 --max-size 64 --seed 7 --steps 6 "${dit[@]}"
    --set "rounds=1,windows=2,window_frames=9,first_round=20,last_round=40")
fix() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" fix "$scene" --out "$out" "${options[@]}" "$@" > "$log" 2>&1
}

fix "$scratch/whole" --threads 2 || fail "the undisturbed run failed"
[ ! -e "$scratch/whole/dit.checkpoint" ] || fail "the clip's checkpoint is left behind"
grep -q '"solver": *"ddim"' "$scratch/whole/metrics.json" || fail "metrics.json does not tell the solver"
fix "$scratch/one" --threads 1 || fail "the run with one worker failed"
cmp "$scratch/whole/splats.ply" "$scratch/one/splats.ply" || fail "one and two workers differ"

kills=0
kill_clips() { # OUT TIMES OPTION...: kill -9 as soon as a clip is at work, then a last run to the end
    local out=$1 left=$2 pid
    shift 2
    while [ "$left" -gt 0 ]; do
        rm -f "$out/dit.checkpoint"
        "$gsfix" fix "$scene" --out "$out" "${options[@]}" "$@" --resume > "$log" 2>&1 &
        pid=$!
        while kill -0 "$pid" 2> /dev/null && [ ! -e "$out/dit.checkpoint" ]; do sleep 0.01; done
        kill -9 "$pid" 2> /dev/null || true
        wait "$pid" 2> /dev/null && break # it was done before
        kills=$((kills + 1)) left=$((left - 1))
    done
    fix "$out" "$@" --resume || fail "the last run failed after $kills kills"
}
kill_clips "$scratch/killed" 3
cmp "$scratch/whole/splats.ply" "$scratch/killed/splats.ply" || fail "differs after $kills kills"

# One clip: the frames that the first window of the scene gave.
mkdir -p "$scratch/clip"
for frame in "$scratch"/whole/fixed/*window1*.png; do cp "$frame" "$scratch/clip/"; done
restore() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" restore "$scratch/clip" --out "$out" "${dit[@]}" --steps 40 "$@" > "$log" 2>&1
}
restore "$scratch/restored" || fail "restore failed"
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
restore "$scratch/fast" --steps 8 --solver unipc --guidance-until 0.5 --strength 0.5 --block-cache 0.1 --int8 --bf16 ||
    fail "the options that save steps failed"

expect() { # STATUS TEXT COMMAND...
    local status=$1 text=$2 got=0
    shift 2
    "$@" > "$log" 2>&1 || got=$?
    [ "$got" = "$status" ] || fail "exit status $got, not $status: $*"
    grep -q -- "$text" "$log" || fail "does not say \"$text\": $*"
}
expect 1 "does without it" "$gsfix" restore "$scratch/clip" --out "$scratch/x" --restorer "dit:$scratch/model"
expect 2 "--solver" "$gsfix" restore "$scratch/clip" --out "$scratch/x" --restorer warp --solver ddim
expect 1 "config.json" "$gsfix" restore "$scratch/clip" --out "$scratch/x" "${dit[@]}" --restorer "dit:$scratch/none"
head -c 1000 "$scratch/model/features.safetensors" > "$scratch/cut.safetensors"
expect 1 "cut.safetensors" "$gsfix" restore "$scratch/clip" --out "$scratch/x" "${dit[@]}" \
    --ref-features "$scratch/cut.safetensors"

# From photos alone: caption, prompts and reference tokens by the model's own encoders.
"$make_model" "$scratch/all" --size tiny > "$log" 2>&1 || fail "make_model failed"
alone=(--restorer "dit:$scratch/all" --set "rounds=1,windows=1,window_frames=9,first_round=20,last_round=40")
options=(--views 3 --iterations 60 --checkpoint-every 5 --max-size 64 --seed 7 --steps 4)
fix "$scratch/photos" "${alone[@]}" --save-features "$scratch/saved.safetensors" || fail "the run from photos alone failed"
for stage in caption text dinov2 vggt "vae encode" transformer "vae decode"; do
    grep -q "\"name\": *\"$stage\"" "$scratch/photos/metrics.json" || fail "metrics.json does not tell of the stage $stage"
done
kill_clips "$scratch/photos_killed" 1 "${alone[@]}"
cmp "$scratch/photos/splats.ply" "$scratch/photos_killed/splats.ply" || fail "from photos alone: differs after a kill"
fix "$scratch/saved" "${alone[@]}" --ref-features "$scratch/saved.safetensors" || fail "the saved features do not do"
cmp "$scratch/photos/splats.ply" "$scratch/saved/splats.ply" || fail "saved features give something else"
! grep -q '"name": *"caption"' "$scratch/saved/metrics.json" || fail "the captioner ran although prompts were given"
echo "$kills kills"
