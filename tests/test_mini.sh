#!/usr/bin/env bash
# test_mini.sh TRAIN_MINI GSFIX SCRATCH: training of the restorer mini is the same for any number of threads and for a run that
# was killed and resumed; what it learns makes the frames better; gsfix repairs with it, in the loop and as a filter; unusable
# options and files give one line and an exit status.
set -euo pipefail
train=$1 gsfix=$2 scratch=$3
[ -x "$train" ] && [ -x "$gsfix" ] && command -v python3 > /dev/null || { echo "SKIPPED: no program or python3"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
export OMP_WAIT_POLICY=passive # threads that wait must not spin
fail() { echo "FAILED: $*"; exit 1; }

data=(--data data --scenes 4 --check 4 --pixels 48 --fit 17 --crop 32)
short=("${data[@]}" --batch 2 --steps 30 --save-every 5)
"$train" one "${short[@]}" --threads 1 > one.txt
grep -q "^mean: " one.txt || fail "no figures"
"$train" three "${short[@]}" --threads 3 > three.txt
cmp one three || fail "weights depend on the number of threads"
cmp one.state three.state || fail "state depends on the number of threads"
cmp one.txt three.txt || fail "figures depend on the number of threads"
"$train" twice "${short[@]}" --scenes 4,4-4 > /dev/null
cmp one twice || fail "a scene given twice gives other samples"
for seeds in "" 4, 4-3 x 4-x; do
    "$train" none "${short[@]}" --scenes "$seeds" > /dev/null 2>&1 && fail "--scenes '$seeds' is accepted"
done

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

"$train" halves "${short[@]}" --groups 2 --threads 1 > halves.txt
if command -v mpirun > /dev/null && ldd "$train" 2> /dev/null | grep -q libmpi; then
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
    timeout 120 mpirun --oversubscribe --bind-to none --mca mpi_yield_when_idle 1 -np 2 "$train" ranks "${short[@]}" --groups 2 \
        --threads 1 > ranks.txt 2> ranks.log || fail "two ranks: $(tail -1 ranks.log)"
    for file in "" .state .loss.csv; do cmp "halves$file" "ranks$file" || fail "two ranks are not one: $file"; done
    cmp halves.txt ranks.txt || fail "two ranks print other figures than one"
fi

"$train" learned "${data[@]}" --batch 4 --steps 150 --rate 0.003 --threads 1 > learned.txt
awk '/^mean: / { if ($4 < $2 + 0.3) exit 1 }' learned.txt || fail "it has learned nothing: $(tail -1 learned.txt)"

"$train" narrow "${data[@]}" --batch 4 --steps 150 --rate 0.003 --threads 1 --int8 > narrow.txt
[ $((3 * $(stat -c %s narrow))) -lt $((2 * $(stat -c %s learned))) ] || fail "8-bit weights are no smaller"
paste -d' ' learned.txt narrow.txt | awk '/^mean: / { exit ($4 - $10) ^ 2 > 0.05 ^ 2 }' || fail "8-bit weights: $(cat narrow.txt)"

for threads in 1 3; do # its own frames in the rounds, and frames of the splats at the end
    "$train" none --data "own$threads" --scenes 4 --check 0 --pixels 48 --fit 17 --crop 32 --own learned --make-only \
        --threads $threads > /dev/null 2> own.txt || fail "--own: $(tail -1 own.txt)"
done
cmp own1/4.safetensors own3/4.safetensors || fail "frames of --own depend on the number of threads"
[ "$(stat -c %s own1/4.safetensors)" -gt "$(stat -c %s data/4.safetensors)" ] || fail "--own adds no frames"

scene=data/scenes/4
for threads in 1 2; do
    "$gsfix" fix "$scene" --out "fix$threads" --views 3 --iterations 40 --init tracks --restorer mini:learned --filtered \
        --threads $threads --json > "fix$threads.json" 2> fix.txt || fail "gsfix fix: $(tail -1 fix.txt)"
done
cmp fix1/splats.ply fix2/splats.ply || fail "splats depend on the number of threads"
ls fix1/filtered/*.png > /dev/null || fail "no filtered views"
python3 - << 'PY' || fail "metrics.json"
import json
m = json.load(open("fix1/metrics.json"))
views = [v["psnr_filtered"] for v in m["per_view"]]
assert abs(m["filtered"]["psnr"] - sum(views) / len(views)) < 1e-9 and m["filtered"]["ssim"] is not None, m["filtered"]
assert m["filtered"]["psnr"] != m["psnr"] and sum(r["frames_restored"] for r in m["rounds"]) > 0
PY
"$gsfix" render fix1/splats.ply --scene "$scene" --views 3 --restorer mini --out clean > /dev/null 2>&1 # weights that come along
"$gsfix" render fix1/splats.ply --scene "$scene" --views 3 --restorer mini --fixed-exposure --out fixed > /dev/null 2>&1
"$gsfix" render fix1/splats.ply --scene "$scene" --out plain > /dev/null 2>&1
[ "$(ls clean/*.png | wc -l)" = "$(ls plain/*.png | wc -l)" ] || fail "not all views are rendered"
cmp -s clean/frame_001.png plain/frame_001.png && fail "the filter changes nothing"
for frame in fixed/*.png; do # photos too small for stereo, so that nothing tells of their exposures
    cmp -s "$frame" "clean/$(basename "$frame")" || fail "exposed without evidence: $frame"
done

# Copies: runs with the seeds that follow, joined. Their splats are kept, and trained again by --resume where they are missing.
common="--views 3 --iterations 40 --init tracks --restorer mini:learned"
"$gsfix" fix "$scene" --out copies $common --seed 4 --filtered --copies 2 > copies.txt 2> fix.txt ||
    fail "--copies: $(tail -1 fix.txt)"
grep -q "^one copy   PSNR" copies.txt || fail "--copies: nothing about one copy"
"$gsfix" fix "$scene" --out single $common --seed 4 > /dev/null 2>&1
"$gsfix" fix "$scene" --out next $common --seed 5 > /dev/null 2>&1
cmp copies/copies/1.ply single/splats.ply || fail "the first copy is not the run itself"
cmp copies/copies/2.ply next/splats.ply || fail "a copy is not the run with its seed"
python3 - << 'PY' || fail "metrics.json of --copies"
import json
m, single, other = (json.load(open(p + "/metrics.json")) for p in ("copies", "single", "next"))
assert m["copies"] == 2 and m["psnr_first_copy"] == single["psnr"] and m["splats"] == single["splats"] + other["splats"]
assert m["psnr"] != single["psnr"] and "copies" not in single, (m["psnr"], single["psnr"])
PY
cp -r copies/filtered copies/splats.ply copies/copies/2.ply .
rm copies/copies/2.ply
"$gsfix" fix "$scene" --out copies $common --seed 4 --filtered --copies 2 --threads 1 --resume > /dev/null 2>&1 ||
    fail "--copies --resume"
cmp copies/copies/2.ply 2.ply && cmp copies/splats.ply splats.ply && diff -r copies/filtered filtered ||
    fail "--resume: other bytes"
interrupt() { # MARK: kill -9 of a new run, or of one that goes on, when MARK is in its copies' checkpoint
    "$gsfix" fix "$scene" --out broken $common --seed 4 --filtered --copies 2 --checkpoint-every 1 --resume > /dev/null 2>&1 &
    pid=$!
    while kill -0 "$pid" 2> /dev/null && ! grep -aq "$1" broken/copies/checkpoint 2> /dev/null; do sleep 0.01; done
    kill -9 "$pid" 2> /dev/null || fail "not killed at $1"
    wait "$pid" 2> /dev/null || true
}
interrupt '"copy":1,'
[ -e broken/copies/1.ply ] && [ ! -e broken/copies/2.ply ] || fail "killed outside the second copy"
interrupt '"copy":2,'
[ -e broken/copies/2.ply ] && [ ! -e broken/splats.ply ] || fail "killed outside the joining"
"$gsfix" fix "$scene" --out broken $common --seed 4 --filtered --copies 2 --resume > /dev/null 2> fix.txt ||
    fail "--copies --resume after kill -9: $(tail -1 fix.txt)"
cmp broken/splats.ply splats.ply && diff -r broken/filtered filtered || fail "kill -9 in the copies: other bytes"
printf '{}' > broken/copies/checkpoint # no longer this program's
"$gsfix" fix "$scene" --out broken $common --seed 4 --filtered --copies 2 --resume > /dev/null 2>&1 && fail "a foreign checkpoint"
"$gsfix" fix "$scene" --out copies $common --seed 4 --filtered --resume > /dev/null 2>&1
diff -qr copies/filtered filtered > /dev/null && fail "the copy changes nothing"
"$gsfix" fix "$scene" --out copies $common --seed 4 --filtered --restart > /dev/null 2>&1
[ ! -e copies/copies/1.ply ] && [ ! -e copies/copies/2.ply ] || fail "a copy of another run stays"
"$gsfix" fix "$scene" --out joined --views 3 --iterations 40 --init tracks --copies 3 > /dev/null 2>&1 || fail "--copies alone"
"$gsfix" fix "$scene" --out few --views 3 --iterations 6 --init tracks --copies 3 > /dev/null 2> fix.txt || fail "few steps"
tail -1 fix.txt | grep -q "100 %.*joining the copies: step 1 of 1 " || fail "progress of --copies: $(tail -1 fix.txt)"
[ -s joined/copies/3.ply ] && [ ! -e joined/filtered ] || fail "--copies without a restorer"
"$gsfix" render fix1/splats.ply --with next/splats.ply --scene "$scene" --views 3 --restorer mini --out both > /dev/null 2>&1
[ "$(ls both/*.png | wc -l)" = "$(ls plain/*.png | wc -l)" ] || fail "--with: not all views are rendered"
cmp -s both/frame_001.png clean/frame_001.png && fail "--with changes nothing"

for wrong in "fix $scene --out x --restorer mini:" "fix $scene --out x --filtered" \
    "fix $scene --out x --restorer mini --copies 17" "render fix1/splats.ply --scene $scene --out x --with fix1/splats.ply" \
    "fix $scene --out x --restorer mini --fixed-exposure" "render fix1/splats.ply --scene $scene --out x --fixed-exposure" \
    "render fix1/splats.ply --path p.json --out x --restorer mini" "render fix1/splats.ply --scene $scene --out x --restorer dit:x"; do
    status=0
    "$gsfix" $wrong > /dev/null 2> error.txt || status=$?
    [ $status = 2 ] && [ "$(wc -l < error.txt)" = 1 ] || fail "gsfix $wrong: status $status"
done
status=0
"$gsfix" fix "$scene" --out x --views 3 --restorer mini:missing > /dev/null 2> error.txt || status=$?
[ $status = 1 ] && grep -q missing error.txt || fail "weights that are not there: $(cat error.txt)"

status=0
"$train" --data data 2> error.txt || status=$?
[ $status = 2 ] || fail "a missing output is no misuse"
printf 'not a scene' > data/5.safetensors
status=0
"$train" none --data data --scenes 5 --crop 32 --pixels 48 2> error.txt || status=$?
[ $status = 1 ] && [ "$(wc -l < error.txt)" = 1 ] && grep -q 5.safetensors error.txt || fail "a broken scene: $(cat error.txt)"
[ ! -e none ] || fail "a failed run wrote weights"
echo "passed"
