#!/usr/bin/env bash
# test_mini.sh TRAIN_MINI SCRATCH: training of the restorer mini is the same for any number of threads and for a run that was
# killed and resumed; what it learns makes the frames better; unusable options and files give one line and an exit status.
set -euo pipefail
train=$1 scratch=$2
[ -x "$train" ] || { echo "SKIPPED: no program"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
fail() { echo "FAILED: $*"; exit 1; }

data=(--data data --scenes 4 --check 4 --pixels 48 --fit 17 --crop 32)
short=("${data[@]}" --batch 2 --steps 30 --save-every 5)
"$train" one "${short[@]}" --threads 1 > one.txt
grep -q "^mean: " one.txt || fail "no figures"
"$train" three "${short[@]}" --threads 3 > three.txt
cmp one three || fail "weights depend on the number of threads"
cmp one.state three.state || fail "state depends on the number of threads"
cmp one.txt three.txt || fail "figures depend on the number of threads"

"$train" killed "${short[@]}" --threads 1 > /dev/null & # until it has written a state, then kill -9
pid=$!
for ((i = 0; i < 400; i++)); do
    [ -e killed.state ] && break
    sleep 0.05
done
kill -9 $pid 2> /dev/null || true
wait $pid || true
"$train" killed "${short[@]}" --threads 2 --resume > killed.txt
cmp one killed || fail "a killed and resumed run has other weights"
cmp one.state killed.state || fail "a killed and resumed run has another state"

"$train" learned "${data[@]}" --batch 4 --steps 150 --rate 0.003 > learned.txt
awk '/^mean: / { if ($4 < $2 + 0.3) exit 1 }' learned.txt || fail "it has learned nothing: $(tail -1 learned.txt)"

status=0
"$train" --data data 2> error.txt || status=$?
[ $status = 2 ] || fail "a missing output is no misuse"
printf 'not a scene' > data/5.safetensors
status=0
"$train" none --data data --scenes 5 --crop 32 --pixels 48 2> error.txt || status=$?
[ $status = 1 ] && [ "$(wc -l < error.txt)" = 1 ] && grep -q 5.safetensors error.txt || fail "a broken scene: $(cat error.txt)"
[ ! -e none ] || fail "a failed run wrote weights"
echo "passed"
