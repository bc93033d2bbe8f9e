#!/usr/bin/env bash
# test_evaluate.sh GSFIX SCENE SCRATCH: gsfix evaluate makes the paper's tables from runs that are those of gsfix fix, writes the
# same bytes when it is killed or given its tasks one by one, and carries on where a scene fails. Stops at the first difference
# with a line and exit 1.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch/in"
export OMP_WAIT_POLICY=passive
cp -r "$scene" "$scratch/in/a"
cp -r "$scene" "$scratch/in/b"
rm "$scratch/in/b/images"/*1.png # another split
common=(--iterations 12 --max-size 48 --checkpoint-every 4)
options=(--views 3 --frames 4 --trajectories reference,interpolate --seeds 2 "${common[@]}")
evaluate() { # OUT OPTION...
    local out=$1
    shift
    "$gsfix" evaluate "$scratch/in/a" "$scratch/in/b" --out "$out" "${options[@]}" "$@" > "$scratch/log" 2> "$scratch/errors"
}
fail() { echo "$0: $*"; tail -n 5 "$scratch/log" "$scratch/errors"; exit 1; }
same() { diff -r -x .gsfix "$scratch/whole" "$1" > "$scratch/log" || fail "$2"; }
misused() { # PATTERN OPTION...: exit 2, one line
    local pattern=$1 status=0
    shift
    "$gsfix" evaluate "$scratch/in/a" --out "$scratch/x" "$@" > "$scratch/log" 2> "$scratch/errors" || status=$?
    [ "$status" = 2 ] && [ "$(wc -l < "$scratch/errors")" = 1 ] && grep -q -e "$pattern" "$scratch/errors" && [ ! -e "$scratch/x" ] ||
        fail "exit status $status, expected 2 and \"$pattern\": $*"
}

begin=$(date +%s%N)
evaluate "$scratch/whole" --threads 2 || fail "the undisturbed run failed"
whole_ms=$(( ($(date +%s%N) - begin) / 1000000 ))

# The tables: titles, columns and rows in the paper's order.
expected="## Restoration of sequences, 3 views
| Artifact
| restored by warp
## Reconstruction from few views
| 3DGS (plain)
| 3DGS, regularised (none)
| repaired by warp
## Ablation of trajectories, 3 views
| Interpolation trajectory, warp
| Reference-guided trajectory, warp
## Restoration per scene, 3 views
| a
| b
| average
## Reconstruction per scene, 3 views, start tracks
| a
| b
| average"
got=$(sed -n 's/^\(## .*\)/\1/p; /^| \(scene\|method\|sequences\|trajectory\) |/d; s/^\(| [^|]*[^ |]\) |.*/\1/p' "$scratch/whole/tables.md")
[ "$got" = "$expected" ] || { diff <(echo "$expected") <(echo "$got") || true; fail "the tables' rows"; }
grep -q '^| method | start | PSNR, 3-view ↑ | SSIM, 3-view ↑ |$' "$scratch/whole/tables.md" || fail "columns"
[ "$(grep -c '^\\begin{tabular}' "$scratch/whole/tables.tex")" = 5 ] && [ "$(grep -c '\\\\$' "$scratch/whole/tables.tex")" -ge 14 ] ||
    fail "tables.tex"
# Means and standard errors, computed again from runs.csv.
awk -F, '
    FNR == NR && $1 == "reconstruction" && /3DGS \(plain\)/ && /PSNR/ { mean = $(NF - 2); error = $(NF - 1); scenes = $NF }
    FNR != NR && $4 == "tracks" && $5 == "plain" { sum[$8] += $9 / 2; n++ }
    END {
        m = (sum[0] + sum[1]) / 2; e = (sum[0] > sum[1] ? sum[0] - sum[1] : sum[1] - sum[0]) / 2
        if (n != 4 || scenes != 2 || m - mean > 2e-6 || mean - m > 2e-6 || e - error > 2e-6 || error - e > 2e-6) {
            print n, scenes, m, mean, e, error; exit 1 }
    }' "$scratch/whole/tables.csv" "$scratch/whole/runs.csv" || fail "means and errors"

# A run is that of gsfix fix, a sequence that of gsfix dataset.
"$gsfix" fix "$scratch/in/a" --out "$scratch/fix" --views 3 --seed 1 --init tracks --restorer warp "${common[@]}" \
    > "$scratch/log" 2> "$scratch/errors" || fail "gsfix fix"
diff -r "$scratch/fix/test" "$scratch/whole/a.k3.tracks.warp.reference.s1/test" > "$scratch/log" || fail "differs from gsfix fix"
psnr=$(sed 's/.*"psnr":\([0-9.]*\).*/\1/; q' <(grep -o '^{"version[^[]*"psnr":[0-9.]*' "$scratch/fix/metrics.json"))
awk -F, -v p="$psnr" '$1 == "a.k3.tracks.warp.reference.s1" { exit !(p - $9 < 1e-6 && $9 - p < 1e-6) }' "$scratch/whole/runs.csv" ||
    fail "PSNR $psnr of gsfix fix is not in runs.csv"
"$gsfix" dataset "$scratch/in/a" --out "$scratch/set" --views 3 --seed 1 --frames 4 "${common[@]}" > "$scratch/log" \
    2> "$scratch/errors" || fail "gsfix dataset"
diff -r -x .gsfix "$scratch/set/a" "$scratch/whole/a.artifacts.k3.s1" > "$scratch/log" || fail "differs from gsfix dataset"

# The gallery: self-contained, a set of pictures for each method, no set twice.
page=$scratch/whole/gallery.html
[ "$(grep -o 'src="\|href=\|https*://' "$page" | wc -l)" = 0 ] || fail "the gallery refers to other files"
[ "$(grep -o '"title":"[^"]*"' "$page" | tr '\n' ' ')" = '"title":"restoration of a sequence, 3 photos" '\
'"title":"reconstruction from 3 photos" "title":"restoration of a sequence, 3 photos" "title":"reconstruction from 3 photos" ' ] ||
    fail "groups of the gallery"
[ "$(grep -c '^\["/9j/' "$page")" = 14 ] || fail "$(grep -c '^\["/9j/' "$page") sets of pictures"

# Killed twice at other moments, then resumed.
for percent in 30 60; do
    "$gsfix" evaluate "$scratch/in/a" "$scratch/in/b" --out "$scratch/killed" "${options[@]}" --resume --threads 1 \
        > "$scratch/log" 2> "$scratch/errors" &
    pid=$!
    sleep "$(awk "BEGIN { print $whole_ms * $percent / 100000 }")"
    kill -9 "$pid" 2> /dev/null || true
    wait "$pid" 2> /dev/null || true
done
evaluate "$scratch/killed" --resume || fail "the last run failed"
same "$scratch/killed" "differs after two kills"
status=0
evaluate "$scratch/killed" || status=$?
[ "$status" = 1 ] && grep -q "resume goes on, --restart begins anew" "$scratch/errors" || fail "results are replaced"
status=0
evaluate "$scratch/killed" --resume --iterations 13 || status=$?
[ "$status" = 1 ] && grep -q "made with" "$scratch/errors" || fail "other settings are taken for the same"
same "$scratch/killed" "differs after refusals"

# A scene that fails does not stop the other one; tables say so. Then it is mended.
mv "$scratch/in/b/images" "$scratch/in/b/away"
status=0
evaluate "$scratch/part" || status=$?
[ "$status" = 1 ] && [ "$(grep -c '^gsfix evaluate: ' "$scratch/errors")" = 1 ] || fail "exit status $status after a failure"
grep -q '^\*\*[0-9]* of 24 runs are missing\*\*' "$scratch/part/tables.md" || fail "tables.md does not say what is missing"
grep -q '^| 3DGS (plain) (1 of 2 scenes) |' "$scratch/part/tables.md" || fail "rows do not say how many scenes they have"
mv "$scratch/in/b/away" "$scratch/in/b/images"
evaluate "$scratch/part" --resume || fail "the mended run failed"
same "$scratch/part" "differs after a failure"

# Tasks one by one, in an order that their needs allow.
"$gsfix" evaluate "$scratch/in/a" --out "$scratch/tasks" --views 3 "${common[@]}" --tables restoration --frames 4 --tasks > "$scratch/list"
[ "$(tr '\n' ' ' < "$scratch/list")" = "a.artifacts.k3.s0 a.restored.artifacts.s0 a.restored.warp.s0 " ] || fail "--tasks"
while read -r task; do
    "$gsfix" evaluate "$scratch/in/a" --out "$scratch/tasks" --views 3 "${common[@]}" --tables restoration --frames 4 --task "$task" \
        > "$scratch/log" 2> "$scratch/errors" || fail "--task $task"
done < "$scratch/list"
cmp "$scratch/tasks/a.restored.warp.s0/result.json" "$scratch/whole/a.restored.warp.s0/result.json" || fail "task by task"

# The paper's figures, for scenes that it knows.
mv "$scratch/in/a" "$scratch/in/032dee9fb0a8bc1b"
"$gsfix" evaluate "$scratch/in/032dee9fb0a8bc1b" --out "$scratch/paper" --views 3 --restorers none --benchmark dl3dv --frames 4 \
    "${common[@]}" > "$scratch/log" 2> "$scratch/errors" || fail "--benchmark"
grep -q '^| GSFixer | paper, same scenes | 23.07 | 0.709 | 0.196 |' "$scratch/paper/tables.md" || fail "restoration in the paper"
grep -q '^| GSFixer | paper, same scenes | 16.57 | 0.565 | 0.455 |' "$scratch/paper/tables.md" || fail "reconstruction in the paper"
mv "$scratch/in/032dee9fb0a8bc1b" "$scratch/in/a"

misused 'no "wrap"' --trajectories wrap
misused '--restorer wrap: choose from' --restorers wrap
misused 'warp stands there twice' --restorers warp,warp
misused 'expected numbers' --views 3,x
misused 'none of --restorers is dit' --conditions 2d,3d
misused 'several --trajectories' --tables trajectories
misused 'needs --models' --which lpips_vgg_raw
misused 'a whole number from 1' --seeds 0
misused 'choose from dl3dv|mipnerf360' --benchmark tanks
echo "same bytes after two kills, a failure and task by task; an undisturbed run takes $whole_ms ms"
