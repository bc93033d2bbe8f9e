#!/usr/bin/env bash
# test_gsfix.sh GSFIX SCENE SCRATCH: every command, its exit codes and the contents of its files. SCENE: made by make_scene.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
readme=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)/README.md
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
export OMP_WAIT_POLICY=passive
failures=0
fail() { echo "FAILED: $*"; failures=$((failures + 1)); }
expect() { # STATUS COMMAND...: checks the exit status and, if it is not 0, that one line explains it
    local want=$1 got=0
    shift
    "$@" > stdout 2> stderr || got=$?
    [ "$got" = "$want" ] || { fail "status $got, not $want: $*"; tail -n 3 stderr; }
    if [ "$want" != 0 ]; then [ "$(grep -c '^gsfix' stderr)" = 1 ] || { fail "not one line of error: $*"; cat stderr; }; fi
}
holds() { grep -q -- "$1" "$2" || fail "$2 does not hold $1"; }
is_json() { # one object on one line with balanced braces
    [ "$(wc -l < "$1")" = 1 ] && head -c 1 "$1" | grep -q '{' && tail -c 2 "$1" | grep -q '}' || fail "$1 is not one JSON object"
    if command -v python3 > /dev/null; then python3 -c 'import json, sys; json.load(open(sys.argv[1]))' "$1" || fail "$1 is not JSON"; fi
}

# usage errors: exit status 2
expect 2 "$gsfix" bogus
expect 2 "$gsfix" dataset "$scene"
expect 2 "$gsfix" evaluate
expect 2 "$gsfix" fix "$scene"
expect 1 "$gsfix" fix "$scene" --out x --restorer dit:models
expect 2 "$gsfix" fix "$scene" --out x --restorer nonsense
expect 2 "$gsfix" fix "$scene" --out x --condition 3d
expect 2 "$gsfix" fix "$scene" --out x --init nonsense
expect 2 "$gsfix" fix "$scene" --out x --iterations 0
expect 2 "$gsfix" fix "$scene" --out x --iterations 10x
expect 2 "$gsfix" fix "$scene" --out x --set nonsense=1
for setting in rounds=1.5 rounds=1e9 rounds=nan rounds= lambda_ssim=-5 dropout=1 dropout=-0.1 sh_degree=4 random_points=0 lr_means=-2 \
    mcmc=2 max_splats=-1 max_splats=1e10 windows=-1 lazy_adam=0.5; do
    expect 2 "$gsfix" fix "$scene" --out x --set $setting
done
expect 2 "$gsfix" fix "$scene" --out x --views 0
expect 2 "$gsfix" fix "$scene" --out x --views=-3
expect 2 "$gsfix" fix "$scene" --out x --resume --restart
expect 2 "$gsfix" fix "$scene" --out x --factor 2 --max-size 99
expect 2 "$gsfix" fix "$scene" "$scene" --out x
expect 2 "$gsfix" fix "$scene" --out x --compare
expect 2 "$gsfix" fix "$scene" --out x --compare --restorer none
for color in red 1,1 0,0,2 1,1,1,1 nan,0,0 ,0,0; do expect 2 "$gsfix" fix "$scene" --out x --background=$color; done
expect 2 "$gsfix" fix "$scene" --out x --photo-masks maybe
expect 2 "$gsfix" render x.ply --out x
for color in random photos; do expect 2 "$gsfix" render x.ply --scene "$scene" --out x --background $color; done
expect 2 "$gsfix" metrics a b --which lpips
expect 2 "$gsfix" metrics a b --models m
expect 2 "$gsfix" metrics a b --which lpips_vgg
expect 1 "$gsfix" metrics a b --which lpips_vgg --models nothing_here
expect 2 "$gsfix" metrics a b --which overall_consistency --models m
expect 2 "$gsfix" metrics a b --prompt "a room"
expect 1 "$gsfix" metrics a b --which overall_consistency --models nothing_here --prompt "a room"
expect 2 "$gsfix" path "$scene" --out x.json --frames 10 --windows 3
expect 2 "$gsfix" info "$scene" --out x
expect 2 "$gsfix" fix "$scene" --out x --also ply
# failures: exit status 1
expect 1 "$gsfix" info nothing_here
expect 1 "$gsfix" info nothing_here.ply
expect 1 "$gsfix" info nothing_here.spz
expect 1 "$gsfix" fix nothing_here --out x
expect 1 "$gsfix" fix "$scene" --out /proc/no/such/folder --views 3
expect 1 "$gsfix" fix "$scene" --out x --views 999
[ ! -e x ] || fail "a refused run leaves a folder"
expect 1 "$gsfix" metrics nothing_here nothing_there
printf 'no_such_photo.png\n' > names
expect 1 "$gsfix" fix "$scene" --out x --views names
# help and version
for command in info fix render filter path restore metrics masks; do
    expect 0 "$gsfix" $command --help
    holds --json stdout
done
expect 0 "$gsfix" --version
expect 0 "$gsfix" info "$scene"
expect 0 "$gsfix" info "$scene" --json
is_json stdout

# fix with an external restorer, which copies the frames with full confidence everywhere
cat > copy.sh <<'SH'
#!/bin/sh
[ -s "$1/cameras.json" ] && [ -s "$1/depth/00000.npy" ] && [ -s "$1/alpha/00000.png" ] && [ -s "$1/refs/00000.png" ] &&
[ -s "$1/refs/render/00000.png" ] || exit 3
cp "$1"/frames/*.png "$1/out/"
SH
printf '#!/bin/sh\nsleep 60\n' > slow.sh
printf '#!/bin/sh\ncp "$1"/frames/00000.png "$1/out/"\n' > short.sh
printf '#!/bin/sh\ncp "$1"/frames/*.png "$1/out/"; cp "$1"/refs/00000.png "$1/out/00001.png"; printf x > "$1/out/00002.png"\n' > broken.sh
chmod +x ./*.sh
small=(--views 3 --iterations 30 --set "rounds=1,windows=1,window_frames=4" --max-size 48)
expect 0 "$gsfix" fix "$scene" --out a "${small[@]}" --restorer "exec:$PWD/copy.sh" --also splat,spz,glb --json
is_json stdout
is_json a/metrics.json
cmp stdout a/metrics.json || fail "--json and metrics.json differ"
for key in psnr ssim per_view seconds total init train render restore distill iterations splats peak_rss_bytes seed threads isa \
    switches version command; do holds "\"$key\":" a/metrics.json; done
for value in '"rounds":1' '"windows":1' '"window_frames":4' '"lambda":1' '"first_round":[1-9][0-9]*' '"densify_interval":100' \
    '"lr_means":0.00016' '"lambda_ssim":0.2' '"dropout":0.2' '"trajectory":"reference"' '"antialiased":"off"'; do
    holds "\"switches\":.*$value[,}]" a/metrics.json # the settings in effect, with defaults filled in
done
for file in splats.ply report.html checkpoint fixed/round1_window1_00001.png; do [ -s a/$file ] || fail "no a/$file"; done
[ -z "$(find a -name "job*")" ] || fail "the job folder was left behind"
if grep -oE '(src|href)="?(https?:)?//[^"]*' a/report.html; then fail "report.html points elsewhere"; fi
expect 1 "$gsfix" fix "$scene" --out b "${small[@]}" --restorer "exec:$PWD/short.sh"
holds "out/0000.*png was not written" stderr
expect 1 "$gsfix" fix "$scene" --out b --restart "${small[@]}" --restorer "exec:$PWD/broken.sh"
holds "out/0000" stderr
expect 1 "$gsfix" fix "$scene" --out b --restart "${small[@]}" --restorer "exec:$PWD/slow.sh" --restorer-timeout 0.3
holds "took longer" stderr
expect 1 "$gsfix" fix "$scene" --out b --restart "${small[@]}" --restorer "exec:exit 5"
holds "status 5" stderr
# the other starts, the three paths, warp, plain; without repair there are no frames
for init in embree tracks both all dense random; do
    expect 0 "$gsfix" fix "$scene" --out c --restart --views 3 --iterations 2 --max-size 48 --init $init --json
    holds "\"init\":\"$init\"" stdout
done
for trajectory in reference ellipse interpolate spread; do
    expect 0 "$gsfix" fix "$scene" --out d --restart "${small[@]}" --restorer warp --trajectory $trajectory --quality exact
done
expect 0 "$gsfix" path "$scene" --views 3 --max-size 48 --kind ellipse --frames 7 --out given.json
expect 0 "$gsfix" fix "$scene" --out given "${small[@]}" --restorer warp --path given.json --quality exact
holds '"trajectory":"given"' given/metrics.json
[ "$(ls given/fixed | wc -l)" = 4 ] || fail "not the frames of a given path"
cmp -s given/splats.ply d/splats.ply && fail "--path changes nothing"
expect 2 "$gsfix" fix "$scene" --out given "${small[@]}" --restorer warp --path given.json --trajectory ellipse
echo '{"cameras":[]}' > none.json
expect 1 "$gsfix" fix "$scene" --out given2 "${small[@]}" --restorer warp --path none.json
holds "no cameras" stderr
expect 0 "$gsfix" fix "$scene" --out e --views 3 --iterations 5 --max-size 48 --regularize off
[ ! -e e/fixed ] || fail "frames without a restorer"
for name in dropout opacity_decay scale_penalty opacity_penalty depth_smoothness; do
    holds "\"$name\":0," e/metrics.json
    holds "<dt>$name</dt><dd>off</dd>" e/report.html
done
expect 0 "$gsfix" fix "$scene" --out e --restart --views 3 --iterations 2 --max-size 48 --regularize off --set mcmc=1
for name in scale_penalty opacity_penalty; do holds "\"$name\":0.01," e/metrics.json; done # MCMC's own

# a list of names with a byte order mark
printf '\xef\xbb\xbfframe_002.png\r\nframe_003.png\nframe_004.png\n' > names
expect 0 "$gsfix" fix "$scene" --out marked --views names --iterations 2 --max-size 48

# Masks change splats and metrics, are inputs like photos, and are ignored by --photo-masks off. Here the folder masks holds
# the photos themselves, so that dark pixels hardly count.
mkdir -p cut/images cut/masks
cp -r "$scene/sparse" cut/
cp "$scene"/images/* cut/images/
for name in "$scene"/images/*; do cp "$name" "cut/masks/$(basename "${name%.*}").png"; done
plain=(--views 3 --iterations 10 --max-size 48)
expect 0 "$gsfix" fix cut --out cut_on "${plain[@]}" --json
holds '"photo_masks":"on","photos_masked":[1-9]' stdout
holds 'pixels that count' stdout
expect 0 "$gsfix" fix cut --out cut_off "${plain[@]}" --photo-masks off --json
holds '"photo_masks":"off","photos_masked":0' stdout
expect 0 "$gsfix" fix "$scene" --out uncut "${plain[@]}"
cmp cut_off/splats.ply uncut/splats.ply || fail "--photo-masks off looks at masks"
if cmp -s cut_on/splats.ply uncut/splats.ply; then fail "masks change nothing"; fi
cp "$scene/images/frame_002.png" cut/masks/frame_001.png
expect 1 "$gsfix" fix cut --out cut_on "${plain[@]}" --resume
holds "masks/frame_001.png" stderr
printf x > cut/masks/frame_001.png
expect 1 "$gsfix" fix cut --out cut_on --restart "${plain[@]}"
holds "masks/frame_001.png" stderr
for color in white random photos 0.25,0.5,1; do
    expect 0 "$gsfix" fix "$scene" --out colored --restart "${plain[@]}" --background $color --json
done
holds '"background":\[0.25,0.5,1\]' stdout
expect 0 "$gsfix" render colored/splats.ply --scene "$scene" --max-size 48 --out on_white --background white
expect 0 "$gsfix" render colored/splats.ply --scene "$scene" --max-size 48 --out on_its_own # kept by the file
if cmp -s on_white/frame_001.png on_its_own/frame_001.png; then fail "the background changes nothing"; fi
expect 0 "$gsfix" render colored/splats.ply --scene "$scene" --max-size 48 --out on_given --background 0.25,0.5,1
cmp on_given/frame_001.png on_its_own/frame_001.png || fail "the splats' background is lost"

# --compare: the metrics without repair equal those of a run without repair, the others those of a run without --compare
expect 0 "$gsfix" fix "$scene" --out compared "${small[@]}" --restorer warp --compare --seed 3
holds "repair alone: [+-]" stdout
expect 0 "$gsfix" fix "$scene" --out repaired "${small[@]}" --restorer warp --seed 3
expect 0 "$gsfix" fix "$scene" --out unrepaired "${small[@]}" --restorer none --seed 3
cmp compared/splats.ply repaired/splats.ply || fail "--compare changes the splats"
for picture in unrepaired/test/*.png; do
    cmp "$picture" "compared/report/without/${picture##*/}" || fail "--compare: another picture without repair"
done
first() { grep -o "\"$1\":[^,]*" "$2" | head -n 1 | cut -d : -f 2; }
for key in psnr ssim; do
    [ "$(first ${key}_without_repair compared/metrics.json)" = "$(first $key unrepaired/metrics.json)" ] ||
        fail "--compare: another $key without repair"
    [ "$(first $key compared/metrics.json)" = "$(first $key repaired/metrics.json)" ] || fail "--compare: another $key"
done
[ "$(first psnr_without_repair compared/metrics.json)" != "$(first psnr compared/metrics.json)" ] || fail "the repair changed nothing"
holds '"curve_without_repair":' compared/metrics.json
holds "without repair | with repair\|without | with repair" compared/report.html
if grep -q "without repair" repaired/report.html; then fail "a report without --compare speaks of it"; fi

# the other commands
expect 0 "$gsfix" masks "$scene" --views 3 --model a/splats.ply --out masks --max-size 48 --json
is_json stdout
expect 0 "$gsfix" fix "$scene" --out f --views 3 --iterations 5 --max-size 48 --masks masks --json
holds '"psnr_seen":' stdout
expect 1 "$gsfix" fix "$scene" --out f --restart --views 3 --iterations 5 --max-size 40 --masks masks
# metrics with the same masks gives fix's figures for the images that fix wrote (up to rounding to 8 bits)
expect 0 "$gsfix" masks "$scene" --views 3 --model a/splats.ply --out masks_full
expect 0 "$gsfix" fix "$scene" --out full --views 3 --iterations 5 --masks masks_full
expect 0 "$gsfix" metrics full/test "$scene/images" --masks masks_full --json
numbers() { grep -o "\"$1\":[-+.0-9e]*" "$2" | cut -d : -f 2; } # of a file, in its order
for key in psnr psnr_seen; do # the mean is the last value that metrics prints and the first one in metrics.json
    says=$(numbers $key stdout | tail -n 1) said=$(numbers $key full/metrics.json | head -n 1)
    awk -v a="$says" -v b="$said" 'BEGIN { exit !(a != "" && b != "" && a - b < 0.02 && b - a < 0.02) }' ||
        fail "metrics: $key is $says, fix said $said"
done
[ "$(numbers psnr stdout | tail -n 1)" != "$(numbers psnr_seen stdout | tail -n 1)" ] || fail "metrics: the masks change nothing"
expect 0 "$gsfix" info a/splats.ply
splats=$(grep '^splats' stdout)
for file in splats.splat splats.spz splats.glb; do # the same number of splats
    expect 0 "$gsfix" info a/$file
    [ "$(grep -o '^splats *[0-9]*' stdout)" = "$(echo "$splats" | grep -o '^splats *[0-9]*')" ] || fail "a/$file has other splats"
    expect 0 "$gsfix" render a/$file --scene "$scene" --max-size 48 --out frames_$file
done
expect 0 "$gsfix" convert a/splats.ply --out again.glb
expect 0 "$gsfix" convert again.glb --out again.ply
cmp -s a/splats.splat <("$gsfix" convert again.ply --out again.splat > stdout && cat again.splat) || fail "convert: there and back differs"
expect 1 "$gsfix" convert a/splats.ply --out again.obj
echo mine > mine.spz
expect 1 "$gsfix" convert a/splats.ply --out mine.spz
holds mine mine.spz
expect 0 "$gsfix" render a/splats.ply --scene "$scene" --max-size 48 --out frames --depth --alpha
expect 0 "$gsfix" metrics a/test frames --which psnr,ssim_3dgs,ssim_torchmetrics,ssim_skimage --json
holds '"ssim_skimage":' stdout
holds '"ssim_3dgs":1[,}]' stdout # the render of the saved splats is the image that fix wrote
expect 0 "$gsfix" path "$scene" --views 3 --frames 8 --out path.json
expect 0 "$gsfix" render a/splats.ply --path path.json --out flight --depth
expect 0 "$gsfix" metrics flight flight --which temporal_flickering --json
holds '"temporal_flickering":0\.[5-9]' stdout # a slow flight
expect 1 "$gsfix" metrics flight flight --which ms_ssim # too small for five scales
holds "smaller than the window" stderr
[ "$(ls flight/*.png | wc -l)" = 8 ] && [ "$(ls flight/depth/*.npy | wc -l)" = 8 ] || fail "not 8 frames and depths"
expect 0 "$gsfix" filter "$scene" --views 3 --out filtered
ln -s "$scene/images" filtered/images
expect 0 "$gsfix" info filtered
sed -n '/by the tests as restore.sh -->/,/^```$/p' "$readme" | sed '1,2d;$d' > restore.sh # of README's tutorial
expect 0 "$gsfix" restore flight --restorer "exec:sh $PWD/restore.sh" --out restored
cmp flight/00003.png restored/00003.png || fail "a copied frame changed"
expect 1 "$gsfix" restore flight --restorer warp --out restored
holds "cameras.json" stderr
# a restorer's job folder contains everything that warp needs
expect 1 "$gsfix" fix "$scene" --out g "${small[@]}" --restorer "exec:exit 5"
expect 0 "$gsfix" restore g/job-* --restorer warp --out warped --json
is_json stdout
[ "$(ls warped/*.png | wc -l)" = 4 ] || fail "not 4 frames"

# Ctrl-C leaves a checkpoint that can be resumed
"$gsfix" fix "$scene" --out h --views 3 --iterations 100000 --max-size 48 > stdout 2> stderr &
pid=$!
for _ in $(seq 100); do grep -q "step" stderr && break; sleep 0.1; done
sleep 0.3
kill -INT $pid
status=0
wait $pid || status=$?
[ "$status" = 1 ] || fail "Ctrl-C: status $status"
holds "stopped at step" stderr
[ -s h/checkpoint ] || fail "Ctrl-C left no checkpoint"
[ "$failures" = 0 ] || { echo "$failures failures"; exit 1; }
echo "all commands as they should be"
