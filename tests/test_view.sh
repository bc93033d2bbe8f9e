#!/usr/bin/env bash
# test_view.sh GSFIX SCENE SCRATCH: gsfix view opens a window (of Xvfb, or without one of SDL's dummy driver), trains a scene in
# it until the photos are better than at the start, goes around, saves what the window shows, and does the same for splats.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
scene=$(realpath "$scene") gsfix=$(realpath "$gsfix")
cd "$scratch"
export OMP_WAIT_POLICY=passive
fail() { echo "$0: $*"; cat log; exit 1; }
view() { # as the user's command, in a window
    if command -v xvfb-run > /dev/null; then xvfb-run -a -s "-screen 0 1280x800x24" "$gsfix" view "$@"
    else SDL_VIDEODRIVER=dummy "$gsfix" view "$@"; fi
}
view nothing.ply --screenshot nothing.png > log 2>&1 && fail "a missing file is shown"
grep -q "no window system" log && { echo "SKIPPED: built without SDL2"; exit 77; }
grep -q "nothing.ply" log || fail "a missing file is not named"
view "$scene" --views 3 --iterations 100 --background black --screenshot scene.png --orbit 20 --json > log 2>&1 || fail "the scene is not shown"
number() { grep -o "\"$1\":[-+.0-9e]*" log | head -n 1 | cut -d : -f 2; }
awk -v a="$(number psnr_before)" -v b="$(number psnr)" 'BEGIN { exit !(a != "" && b > a + 3) }' || fail "PSNR does not rise"
"$gsfix" fix "$scene" --views 3 --iterations 40 --out fixed > log 2>&1 || fail "no splats to show"
view fixed/splats.ply --screenshot near.png > log 2>&1 || fail "the splats are not shown"
view fixed/splats.ply --screenshot far.png --orbit 40 > log 2>&1 || fail "the splats are not shown after going around"
for picture in scene near far; do # a window's size, and something in it: a black PNG of that size has less than 4 kB
    [ "$(od -An -tu1 -j16 -N8 $picture.png | tr -s ' ')" = " 0 0 3 192 0 0 2 128" ] || fail "$picture.png has another size"
    [ "$(stat -c %s $picture.png)" -gt 8000 ] || fail "$picture.png is empty"
done
cmp -s near.png far.png && fail "going around changes nothing"
echo mine > mine.png
view fixed/splats.ply --screenshot mine.png > log 2>&1 && fail "a foreign file is replaced"
[ "$(cat mine.png)" = mine ] || fail "a foreign file is lost"
