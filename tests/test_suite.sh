#!/usr/bin/env bash
# test_suite.sh MAKE_SCENE SCRATCH [SEEDS] [SCENES]: the family of procedural scenes from the command line: names, splits,
# refusals, a contact sheet of SEEDS scenes of which no two are alike, and SCENES of the benchmark (13 and 2 by default;
# 100 and 20 take a quarter of an hour).
set -euo pipefail
make_scene=$1 scratch=$2 seeds=${3:-13} scenes=${4:-2}
[ -x "$make_scene" ] || { echo "SKIPPED: no program"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
fail() { echo "FAILED: $*"; exit 1; }

"$make_scene" --suite > names
[ "$(sort -u names | wc -l)" = 20 ] || fail "the benchmark does not have 20 names"
"$make_scene" --help > help
while read -r name; do grep -qw "$name" help || fail "--help does not mention $name"; done < names

small="--views 17 --width 48 --height 36 --points 60"
for name in $(head -n "$scenes" names); do
    # shellcheck disable=SC2086 # words are meant to be split
    "$make_scene" "scene_$name" --scene "$name" $small
    grep -q '"layout":' "scene_$name/truth/scene.json" || fail "$name: no layout in scene.json"
    [ "$(wc -l < "scene_$name/splits/test.txt")" = 3 ] && [ "$(wc -l < "scene_$name/splits/train_9.txt")" = 9 ] || fail "$name: splits"
    sort "scene_$name"/splits/{test,train_9}.txt | uniq -d | grep -q . && fail "$name: a test photo is a training photo"
    [ "$(wc -l < "scene_$name/splits/train_3.txt")" = 3 ] && [ -s "scene_$name/images/frame_017.png" ] || fail "$name: files"
done
for wrong in "--layout castle" "--scene nowhere" "--layout" "--sheet 0"; do
    status=0
    # shellcheck disable=SC2086
    "$make_scene" wrong $wrong 2> log || status=$?
    [ $status = 2 ] && [ -s log ] && [ ! -e wrong ] || fail "$wrong: status $status"
done
sed -i 's/"layout":"[a-z_]*"/"layout":"castle"/' "scene_$(head -n 1 names)/truth/scene.json"
if "$make_scene" "scene_$(head -n 1 names)" --render none.json --out pictures 2> log; then fail "renders a castle"; fi
grep -q 'no valid "layout"' log || fail "does not name the layout"

"$make_scene" --sheet "$seeds" --out sheet.png | tee log
difference=$(sed -n 's/.*differ by \([0-9]*\).*/\1/p' log)
[ "$difference" -ge 6 ] || fail "two scenes are alike"
if "$make_scene" --sheet 2 --out sheet.png 2> log; then fail "replaces a sheet"; fi
