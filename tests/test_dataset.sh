#!/usr/bin/env bash
# test_dataset.sh GSFIX SCENE SCRATCH: gsfix dataset writes DL3DV-Res's layout, reads its own manifests back and refuses hostile
# ones with one line, and writes the same bytes when it is killed, cancelled or given its tasks one by one. Stops at the first
# difference with a line and exit 1.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch/in"
export OMP_WAIT_POLICY=passive
cp -r "$scene" "$scratch/in/a"
cp -r "$scene" "$scratch/in/b"
options=(--views 3 --frames 4 --kinds sparse,prune --iterations 16 --clean-iterations 16 --checkpoint-every 4 --max-size 48
    --seed 7 --caption 'a "room"')
dataset() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" dataset "$scratch/in/a" "$scratch/in/b" --out "$out" "${options[@]}" "$@" > "$scratch/log" 2> "$scratch/errors"
}
fail() { echo "$0: $*"; tail -n 5 "$scratch/log" "$scratch/errors"; exit 1; }
same() { diff -r -x .gsfix "$scratch/whole" "$1" > "$scratch/log" || fail "$2"; }
refused() { # LINE PATTERN, COMMAND...: exit 1, and one line that matches
    local pattern=$1 status=0
    shift
    "$@" > "$scratch/log" 2> "$scratch/errors" || status=$?
    [ "$status" = 1 ] && [ "$(grep -vc '^note: \|^[ab] (' "$scratch/errors")" = 1 ] && grep -q "$pattern" "$scratch/errors" ||
        fail "exit status $status, expected one line with \"$pattern\": $*"
}
run_refused() { # the same for runs, whose lines of progress do not count
    local pattern=$1 status=0
    shift
    dataset "$@" || status=$?
    [ "$status" = 1 ] && [ "$(grep -c '^gsfix dataset: ' "$scratch/errors")" = 1 ] && grep -q "$pattern" "$scratch/errors" ||
        fail "exit status $status, expected \"$pattern\": $*"
}

begin=$(date +%s%N)
dataset "$scratch/whole" --threads 2 || fail "the undisturbed run failed"
whole_ms=$(( ($(date +%s%N) - begin) / 1000000 ))

# The layout, by the rules of the release's reader: sorted frames, references by name, a photo for each, a caption.
for kind in lr prune; do
    frames=$(cd "$scratch/whole/a/$kind/3/train_3" && ls | tr '\n' ' ')
    case $frames in
        frame_?????_ref.png\ frame_?????.png\ frame_?????.png\ frame_?????_ref.png\ frame_?????.png\ frame_?????.png\ \
frame_?????_ref.png\ ) ;;
        *) fail "frames of $kind: $frames" ;;
    esac
    for frame in $frames; do
        stem=${frame%.png}
        stem=${stem%_ref}
        [ -s "$scratch/whole/a/nerfstudio/images_4/$stem.png" ] && [ -s "$scratch/whole/a/$kind/3/depth/$stem.npy" ] &&
            [ -s "$scratch/whole/a/$kind/3/alpha/$stem.png" ] || fail "$kind $stem lacks its photo, depth or opacity"
    done
    [ "$(cat "$scratch/whole/a/$kind/3/captions.json")" = '"a \"room\""' ] || fail "captions.json"
done
[ "$(tr '\n' ' ' < "$scratch/whole/scenes.txt")" = "a b " ] || fail "scenes.txt"
cmp "$scratch/whole/a/lr/3/train_3/$frame" "$scratch/whole/b/lr/3/train_3/$frame" || fail "equal scenes differ"
! cmp -s "$scratch/whole/a/lr/3/train_3/$frame" "$scratch/whole/a/prune/3/train_3/$frame" || fail "the kinds do not differ"
[ ! -e "$scratch/whole/a/checkpoint" ] || fail "a checkpoint is left"

# Killed twice and then cancelled, with other numbers of workers. A run that ends before the signal is begun anew, with half the
# delay.
start() { # in the background, resuming
    "$gsfix" dataset "$scratch/in/a" "$scratch/in/b" --out "$scratch/killed" "${options[@]}" --resume --threads "$1" \
        > "$scratch/log" 2> "$scratch/errors" &
    pid=$!
}
stopped() { # STATUS: the run in the background ends with it, or with 0
    status=0
    wait "$pid" 2> /dev/null || status=$?
    [ "$status" = "$1" ] || [ "$status" = 0 ] || fail "a signal ended the run with status $status"
    [ "$status" = "$1" ]
}
disturb() { # PERCENT: of an undisturbed run's time, after which each kill comes
    rm -rf "$scratch/killed"
    for kill in 1 2; do
        start "$kill"
        sleep "$(awk "BEGIN { print $whole_ms * $1 / 100000 }")"
        kill -9 "$pid" 2> /dev/null || true
        stopped 137 || return 1
    done
    [ -e "$scratch/killed/a/checkpoint" ] || [ -e "$scratch/killed/b/checkpoint" ] || return 0 # before or between the scenes
    run_refused "resume goes on" "$scratch/killed"
    run_refused "made with seed" "$scratch/killed" --resume --seed 8
    start 2
    for (( i = 0; i < 400; i++ )); do ! grep -q " %" "$scratch/errors" || break; sleep 0.01; done
    kill -INT "$pid" 2> /dev/null || true
    stopped 1 || return 1
    [ "$(grep -c 'stopped .*resume goes on' "$scratch/errors")" = 1 ] || fail "not cancelled"
}
tries=0
for percent in 40 20 10 5 end; do
    [ "$percent" != end ] || fail "runs end before they can be killed"
    tries=$((tries + 1))
    ! disturb "$percent" || break
done
dataset "$scratch/killed" --resume || fail "the last run failed"
same "$scratch/killed" "differs after two kills and a cancellation"
dataset "$scratch/killed" --resume || fail "a finished run cannot be resumed"
same "$scratch/killed" "differs after resuming a finished run"

# One task at a time, in another order; frames that got lost are made again.
[ "$("$gsfix" dataset "$scratch/in/a" "$scratch/in/b" --out "$scratch/tasks" "${options[@]}" --tasks | tr '\n' ' ')" = "a b " ] &&
    [ ! -e "$scratch/tasks" ] || fail "--tasks"
dataset "$scratch/tasks" --task b || fail "--task b"
cp -r "$scratch/tasks/b" "$scratch/b"
dataset "$scratch/tasks" --resume --task a || fail "--task a"
[ ! -e "$scratch/tasks/dataset.json" ] || fail "--task merges"
dataset "$scratch/tasks" --resume || fail "the merge failed"
same "$scratch/tasks" "differs if made task by task"
! dataset "$scratch/tasks" --task c || fail "--task c was accepted"

# Hostile and damaged files: one line each, exit 1.
"$gsfix" info "$scratch/b/manifest.json" > "$scratch/log" || fail "gsfix info refuses a whole scene"
sequence=$scratch/b/sequences/lr_3_00.json
cp "$sequence" "$scratch/sequence"
edits=('s/"gsfixer sequence 1"/"gsfixer sequence 9"/' 's/"artifact":"lr/"artifact":"..\/lr/' 's/"clean":"nerf/"clean":"\/nerf/'
    's/"depth":"lr\//"depth":"lr\/\/x/' 's/"cameras":"/"cameras":"a\\n/' 's/"views":3/"views":3e9/' 's/"width":[0-9]*/"width":-1/'
    's/"reference":true/"reference":1/' 's/"digests":\["./"digests":["G/' 's/"frames":\[.*\]/"frames":[]/' 's/"psnr":/"snr":/'
    's/"alpha":"lr[^"]*"/"alpha":"lr\/3\/none.png"/' 's/"reference":true/"reference":false/' 's/}$//' 's/"views":3/"views":3,"views":3/')
for edit in "${edits[@]}"; do
    sed "$edit" "$scratch/sequence" > "$sequence"
    ! cmp -s "$scratch/sequence" "$sequence" || fail "no edit: $edit"
    refused "^gsfix info: " "$gsfix" info "$sequence"
done
for bytes in 0 1 20 21 500; do
    head -c "$bytes" "$scratch/sequence" > "$sequence"
    refused "^gsfix info: " "$gsfix" info "$sequence"
done
refused "not as the manifest says" "$gsfix" info "$scratch/b/manifest.json"
cp "$scratch/sequence" "$sequence"
printf x >> "$scratch/b/lr/3/train_3/$frame"
refused "$frame: not as the manifest says" "$gsfix" info "$scratch/b/manifest.json"
sed -i 's/"scene":"b"/"scene":"c"/' "$scratch/tasks/b/manifest.json"
run_refused "not the manifest of this scene" "$scratch/tasks" --resume
echo '{"format":"gsfixer scene 1"}' > "$scratch/tasks/b/manifest.json"
run_refused "manifest.json: not written by gsfix" "$scratch/tasks" --resume
refused "input is read from there" "$gsfix" dataset "$scratch/in/a" --out "$scratch/in" "${options[@]}"
refused "both would be called" "$gsfix" dataset "$scratch/in/a" "$scratch/in/a" --out "$scratch/x" "${options[@]}"
refused "only [0-9]* photos" "$gsfix" dataset "$scratch/in/a" --out "$scratch/x" --views 300
echo "same bytes after two kills, a cancellation and task by task; an undisturbed run takes $whole_ms ms"
