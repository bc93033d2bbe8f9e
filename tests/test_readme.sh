#!/usr/bin/env bash
# test_readme.sh PROGRAM GSFIX MAKE_SCENE SCRATCH: the program in README.md (at most 25 lines in main) writes the same
# splats, byte for byte, as gsfix fix with the same photos; with 3 photos, and with 6, for which the regularisers are weaker
# (not if GSF_TEST_FEW is set).
set -euo pipefail
program=$1 gsfix=$2 make_scene=$3 scratch=$4
[ -x "$program" ] && [ -x "$gsfix" ] && [ -x "$make_scene" ] || { echo "SKIPPED: a program is missing"; exit 77; }
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
export OMP_WAIT_POLICY=passive
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"

lines=$(sed -n '/^int main(/,/^}/p' "$here/../README.md" | sed '1d;$d' | grep -c .)
[ "$lines" -le 25 ] || { echo "FAILED: README's program has $lines lines"; exit 1; }

failures=0
for photos in 3 $([ "${GSF_TEST_FEW:-}" ] || echo 6); do
    "$make_scene" "s$photos" --views $photos --width 60 --height 42 --points 300 > made 2>&1
    (cd "s$photos/images" && ls) > "all$photos.txt" # no photo is held out
    "$program" "s$photos" "readme$photos.ply"
    "$gsfix" fix "s$photos" --out "fix$photos" --views "all$photos.txt" --restorer warp > fix.log 2>&1
    grep -q '"init":"dense"' "fix$photos/metrics.json" || { echo "FAILED: $photos photos: another start than expected"; failures=1; }
    grep -q "\"dropout\":0.$([ $photos = 3 ] && echo 2 || echo 1)[,}]" "fix$photos/metrics.json" ||
        { echo "FAILED: $photos photos: another dropout than expected"; failures=1; }
    cmp "readme$photos.ply" "fix$photos/splats.ply" || { echo "FAILED: $photos photos"; failures=1; }
done
[ $failures = 0 ] || exit 1
echo "README's program gives what gsfix fix gives"
