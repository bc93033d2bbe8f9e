#!/usr/bin/env bash
# test_restorer_training.sh TRAIN_RESTORER GSFIX MAKE_MODEL SCENE SCRATCH: trains the transformer of a small model with random
# weights, and adapters for it, on a data set that gsfix makes: the loss falls; killed and resumed runs, and other numbers of
# threads and ranks, give the same bytes; gsfix repairs with the result; unusable files and options give one line and a status.
set -euo pipefail
train=$1 gsfix=$2 make_model=$3 scene=$4 scratch=$5
[ -x "$train" ] && [ -x "$gsfix" ] && [ -x "$make_model" ] && [ -d "$scene" ] || { echo "SKIPPED: no programs or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
export OMP_WAIT_POLICY=passive OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
fail() { echo "FAILED: $*"; tail -n 3 log 2> /dev/null; exit 1; }
"$make_model" model --size tiny > log 2>&1 || fail "make_model"
"$gsfix" dataset "$scene" --out data --views 3 --iterations 20 --max-size 48 --frames 4 --caption "a wall" > log 2>&1 ||
    fail "gsfix dataset"

base=(--model model --data data --cache cache --batch 2 --save-every 2)
run() { # OUT OPTION...
    local out=$1
    shift
    "$train" "$out" "${base[@]}" "$@" > log 2>&1 || fail "$out: status $?"
}
same() { # OUT OUT FILE...
    local a=$1 b=$2 file
    shift 2
    for file in "$@"; do cmp "$a/$file" "$b/$file" || fail "$b/$file differs from that of $a"; done
}
killed() { # OUT OPTION...: kill -9 once it has written a state, then resumed
    local out=$1 pid i
    shift
    "$train" "$out" "${base[@]}" "$@" > log 2>&1 &
    pid=$!
    for ((i = 0; i < 2000; i++)); do
        [ -e "$out/training.state" ] && break
        kill -0 $pid 2> /dev/null || break
        sleep 0.01
    done
    kill -9 $pid 2> /dev/null || true
    wait $pid 2> /dev/null || true
    run "$out" "$@" --resume
}
weights=transformer/diffusion_pytorch_model.safetensors
full=(--iterations 12 --warmup 2 --average 0.5 --rate 1e-3)
run whole "${full[@]}" --threads 1
[ "$(ls cache | wc -l)" -ge 1 ] || fail "no cache"
run threads "${full[@]}" --threads 3
same whole threads "$weights" training.state training.loss.csv
killed stopped "${full[@]}" --threads 2
same whole stopped "$weights" training.state training.loss.csv training.loss.html

# --bf16 rounds at least the inputs that are kept for the way back.
run rounded "${full[@]}" --threads 1 --bf16
run rounded2 "${full[@]}" --threads 3 --bf16
same rounded rounded2 "$weights" training.state training.loss.csv
cmp -s whole/training.state rounded/training.state && fail "--bf16 changes nothing"

lora=(--iterations 12 --warmup 2 --lora 3 --alpha 6 --rate 1e-2)
adapters=(adapter_model.safetensors adapter_config.json training.state training.loss.csv)
run adapted "${lora[@]}" --threads 1
killed adapted2 "${lora[@]}" --threads 2
same adapted adapted2 "${adapters[@]}"
if command -v mpirun > /dev/null && ldd "$train" 2> /dev/null | grep -q libmpi; then
    for n in 1 2; do
        timeout 120 mpirun --oversubscribe --bind-to none --mca mpi_yield_when_idle 1 -np $n "$train" "ranks$n" "${base[@]}" "${lora[@]}" --threads 1 \
            > log 2>&1 || fail "$n ranks"
        same adapted "ranks$n" "${adapters[@]}"
    done
    timeout 120 mpirun --oversubscribe --bind-to none --mca mpi_yield_when_idle 1 -np 2 "$train" full2 "${base[@]}" "${full[@]}" --threads 1 > log 2>&1 ||
        fail "2 ranks"
    same whole full2 "$weights" training.state training.loss.csv
fi

# The loss falls: means of the first and the last steps, each with the same set of sequences and other noise.
run learned --iterations 60 --rate 1e-2 --warmup 5 --lora 4 --drop-references 0 --drop-prompt 0 --threads 1 --save-every 60
awk -F, 'NR > 1 { if (NR <= 16) a += $2; if (NR > 46) b += $2 } END { print a / 15, b / 15; if (!(b < 0.9 * a)) exit 1 }' \
    learned/training.loss.csv || fail "the loss does not fall"

clip=(restore "$(echo data/*/lr/3/train_3)" --steps 2 --caption "a wall" --condition none --any-frames)
restore() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" "${clip[@]}" --out "$out" "$@" > log 2>&1 || fail "restore: $*"
}
restore plain --restorer dit:model
restore trained --restorer dit:whole
restore merged --restorer dit:model --lora learned
restore file --restorer dit:model --lora learned/adapter_model.safetensors
first=$(basename "$(ls plain/*.png | head -n 1)")
cmp -s "plain/$first" "trained/$first" && fail "training changes nothing"
cmp -s "plain/$first" "merged/$first" && fail "adapters change nothing"
cmp "merged/$first" "file/$first" || fail "a file of adapters is not their folder"

expect() { # STATUS TEXT COMMAND...
    local status=$1 text=$2 got=0
    shift 2
    "$@" > log 2>&1 || got=$?
    [ "$got" = "$status" ] || fail "exit status $got, not $status: $*"
    grep -q -- "$text" log || fail "does not say \"$text\": $*"
}
expect 1 "has a run already" "$train" whole "${base[@]}" "${full[@]}"
expect 1 "other settings" "$train" whole "${base[@]}" "${full[@]}" --rate 1e-4 --resume
expect 1 "no linear layer" "$train" none "${base[@]}" --lora 2 --targets to_x
expect 1 "scenes.txt" "$train" none --model model --data missing
expect 2 "usage" "$train" none --model model
expect 0 "M parameters" "$train" --memory --model model
expect 1 "no adapter of a linear layer" "$gsfix" "${clip[@]}" --out x --restorer dit:model --lora "whole/$weights"
expect 2 "--lora" "$gsfix" restore "${clip[1]}" --out x --restorer warp --lora learned
echo "passed"
