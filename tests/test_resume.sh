#!/usr/bin/env bash
# test_resume.sh GSFIX SCENE SCRATCH [KILLS]: a run with --compare that is killed at random moments and resumed writes the same
# bytes as an uninterrupted one; so do runs with one and two workers. Stops at the first difference with a line and exit 1.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3 kills=${4:-5}
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
export OMP_WAIT_POLICY=passive
options=(--views 3 --restorer warp --compare --iterations 90 --checkpoint-every 5 --max-size 64 --seed 7
    --set "rounds=2,windows=2,window_frames=5,densify_from=10,densify_until=80,densify_interval=10,densify_grad=0.00002")
fix() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" fix "$scene" --out "$out" "${options[@]}" "$@" > "$scratch/log" 2>&1
}
fail() { echo "$0: $*"; tail -n 5 "$scratch/log"; exit 1; }

begin=$(date +%s%N)
fix "$scratch/whole" --threads 2 || fail "the undisturbed run failed"
whole_ms=$(( ($(date +%s%N) - begin) / 1000000 ))
fix "$scratch/one" --threads 1 || fail "the run with one worker failed"
cmp "$scratch/whole/splats.ply" "$scratch/one/splats.ply" || fail "one and two workers differ"

# Kills happen at random times during a run; every second one waits until a temporary file shows that a file is being written
# (which has usually been renamed when the kill arrives: the number of those that had not is printed).
done_kills=0 finished_early=0 while_writing=0
RANDOM=${SEED:-12345}
while [ "$done_kills" -lt "$kills" ]; do
    [ "$finished_early" -lt $((5 * kills)) ] || fail "runs end before they can be killed"
    "$gsfix" fix "$scene" --out "$scratch/killed" "${options[@]}" --resume --threads $((1 + RANDOM % 2)) > "$scratch/log" 2>&1 &
    pid=$!
    ms=$(( RANDOM * (whole_ms * 6 / 10 + 50) / 32768 + 20 ))
    sleep "$(printf '%d.%03d' $((ms / 1000)) $((ms % 1000)))"
    if [ $((done_kills % 2)) = 1 ]; then
        for (( i = 0; i < 200000; i++ )); do [ ! -e "$scratch/killed/.gsfix/new" ] || break; done
    fi
    kill -9 "$pid" 2> /dev/null || true
    status=0
    wait "$pid" 2> /dev/null || status=$?
    if [ "$status" = 0 ]; then # it finished before the kill; start over
        finished_early=$((finished_early + 1))
        cmp "$scratch/whole/splats.ply" "$scratch/killed/splats.ply" || fail "differs after $done_kills kills"
        rm -rf "$scratch/killed"
    elif [ "$status" = 137 ]; then
        done_kills=$((done_kills + 1))
        [ ! -e "$scratch/killed/.gsfix/new" ] || while_writing=$((while_writing + 1))
    else
        fail "a resumed run ended with status $status after $done_kills kills"
    fi
done
fix "$scratch/killed" --resume || fail "the last run failed after $kills kills"
cmp "$scratch/whole/splats.ply" "$scratch/killed/splats.ply" || fail "differs after $kills kills"
for view in "$scratch/whole/test/"*.png "$scratch/whole/fixed/"*.png "$scratch/whole/report/without/"*.png; do
    cmp "$view" "${view/whole/killed}" || fail "pictures differ after $kills kills"
done
figures() { # metrics.json without timings
    grep -o '"\(psnr\|ssim\|iteration\|splats\)[a-z_]*":[^,}]*' "$1/metrics.json"
}
[ "$(figures "$scratch/whole")" = "$(figures "$scratch/killed")" ] || fail "figures differ after $kills kills"

# A finished run resumes with the same bytes; changed options are refused and named; a damaged checkpoint is refused.
rm "$scratch/killed/splats.ply"
fix "$scratch/killed" --resume || fail "resuming a finished run failed"
cmp "$scratch/whole/splats.ply" "$scratch/killed/splats.ply" || fail "differs after resuming a finished run"
status=0
fix "$scratch/killed" --resume --regularize off || status=$?
[ "$status" = 1 ] && grep -q "made with" "$scratch/log" || fail "other switches were not refused (status $status)"
head -c 5000 "$scratch/killed/checkpoint" > "$scratch/cut"
mv "$scratch/cut" "$scratch/killed/checkpoint"
status=0
fix "$scratch/killed" --resume || status=$?
[ "$status" = 1 ] && [ "$(grep -c '^gsfix fix: ' "$scratch/log")" = 1 ] || fail "a cut checkpoint was not refused (status $status)"
echo "same bytes after $kills kills ($while_writing while a file was written), with 1 and 2 workers; a run takes $whole_ms ms"
