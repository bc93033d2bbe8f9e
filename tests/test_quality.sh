#!/usr/bin/env bash
# test_quality.sh GSFIX SCENE SCRATCH: bench/quality.py with two starts, two seeds and a peer, which gets only the training
# photos and the points of the start; a second call repeats no run. SCENE: made by make_scene.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
command -v python3 > /dev/null && [ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no python3, program or scene"; exit 77; }
bench=$(cd "$(dirname "${BASH_SOURCE[0]}")/../bench" && pwd)
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
fail() { echo "FAILED: $*"; exit 1; }

"$gsfix" fix "$scene" --out peer --views 3 --iterations 3 --restorer none > log 2>&1 || { cat log; fail "no splats for the peer"; }
cat > opensplat << 'SH'
#!/bin/sh
# opensplat SCENE -n STEPS -o OUT ...: logs its input and writes prepared splats
[ "$2" = -n ] && [ "$3" = 4 ] && [ "$4" = -o ] || exit 3
echo "$(ls "$1/images" | wc -l) $(od -A n -t u8 -N 8 "$1/sparse/0/images.bin") $(od -A n -t u8 -N 8 "$1/sparse/0/points3D.bin")" >> peer.log
cp peer/splats.ply "$5"
SH
chmod +x opensplat
quality() {
    python3 "$bench/quality.py" --gsfix "$gsfix" --scene "$scene" --out out --views 3 --seeds 2 --iterations 4 --jobs 1 \
        --arm plain="--restorer none --regularize off" --arm none="--restorer none" --opensplat ./opensplat > log 2>&1 ||
        { cat log; fail "quality.py"; }
}
quality
[ "$(wc -l < peer.log)" = 4 ] || fail "the peer ran $(wc -l < peer.log) times, not for two starts and two schedules"
while read -r photos images points; do
    [ "$photos $images" = "3 3" ] || fail "the peer was given $photos photos and $images views"
    grep -q "^[a-z]*,3,OpenSplat+*,1,.*,$points,[0-9]*,[0-9.]*.\$" out/quality.csv || fail "no row of the peer with $points points"
done < peer.log
[ "$(sort -u peer.log | wc -l)" = 2 ] || fail "both starts have the same points"
[ "$(wc -l < out/quality.csv)" = 13 ] || fail "$(wc -l < out/quality.csv) lines, not a head and 2 starts x (2 arms x 2 seeds + 2)"
for start in tracks default; do
    grep -q "^| 3 | $start | none - plain |" out/quality.md || fail "no difference of start $start"
done
cp out/quality.csv before.csv
quality
cmp before.csv out/quality.csv && [ "$(wc -l < peer.log)" = 4 ] || fail "a second call runs anew"
echo "two starts, two seeds, a peer: as they should be"
