#!/usr/bin/env bash
# test_weights.sh GSFIX MAKE_SCENE BENCH_METRICS SCRATCH: the metrics that need weights, with random ones in the published files:
# gsfix metrics of two folders and of one, and their columns in the tables of gsfix evaluate.
set -euo pipefail
gsfix=$1 make_scene=$2 bench_metrics=$3 scratch=$4
for program in "$gsfix" "$make_scene" "$bench_metrics"; do
    [ -x "$program" ] || { echo "SKIPPED: no $program"; exit 77; }
done
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
export OMP_WAIT_POLICY=passive
fail() { echo "$0: $*"; tail -n 8 out errors; exit 1; }
works() { "$@" > out 2> errors || fail "exit status $?: $*"; }
usage() { # PATTERN COMMAND...: exit 2 and one line
    local pattern=$1 status=0
    shift
    "$@" > out 2> errors || status=$?
    [ "$status" = 2 ] && grep -q "$pattern" errors || fail "exit status $status, expected \"$pattern\": $*"
}
number() { sed -n "s/.*\"$1\":\\([-0-9.e]*\\).*/\\1/p" out | tail -n 1; }
between() { awk -v x="$1" -v a="$2" -v b="$3" 'BEGIN { exit !(x != "" && x > a && x < b) }' || fail "$4 is $1"; }

works "$bench_metrics" --make models
works "$make_scene" scene --views 8 --width 144 --height 128 --points 800 # AMT needs 128 pixels
pairs=lpips_alex,lpips_vgg,lpips_squeeze,lpips_alex_raw,lpips_vgg_raw,lpips_squeeze_raw
works "$gsfix" metrics scene/images scene/images --which "$pairs,i2v_subject,i2v_background" --models models --json
for name in ${pairs//,/ }; do [ "$(grep -o "\"$name\":0[,}]" out | wc -l)" = 9 ] || fail "$name of equal images"; done
for name in i2v_subject i2v_background; do between "$(number $name)" 0.5 1 $name; done
works "$gsfix" metrics scene/images --which motion_smoothness,temporal_flickering --models models --json # of one folder
between "$(number motion_smoothness)" 0.2 1 motion_smoothness
between "$(number temporal_flickering)" 0.2 1 temporal_flickering
usage "psnr needs DIR_B" "$gsfix" metrics scene/images
usage "i2v_subject needs DIR_B" "$gsfix" metrics scene/images --which temporal_flickering,i2v_subject --models models
usage "two folders at most" "$gsfix" metrics scene/images scene/images scene/images

works "$gsfix" evaluate scene --out tables --views 3 --frames 5 --iterations 40 --restorers none,warp --models models --json \
    --which lpips_vgg_raw,temporal_flickering,i2v_subject,i2v_background,motion_smoothness
column() { sed -n "s/^[a-z]*,$1,tracks,$2,gsfix,\([-0-9.]*\),.*/\1/p" tables/tables.csv; } # ROW GROUP,COLUMN
for name in LPIPS I2V_SC I2V_BC TF MS; do
    for row in Artifact "restored by warp"; do between "$(column "$row" ",$name")" 0 1 "$name of $row"; done
done
said=$(column "repaired by warp" LPIPS,3-view)
works "$gsfix" metrics tables/scene.k3.tracks.warp.reference.s0/test scene/images --which lpips_vgg_raw --models models --json
between "$(number lpips_vgg_raw)" "$(awk -v x="$said" 'BEGIN { print 0.98 * x }')" "$(awk -v x="$said" 'BEGIN { print 1.02 * x }')" \
    "LPIPS of the pictures, not $said," # which are rounded to 8 bits
echo "weights: metrics and columns of evaluate"
