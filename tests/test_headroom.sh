#!/usr/bin/env bash
# test_headroom.sh GSFIX SCENE SCRATCH: additional photos of a synthetic scene equal those that it has;
# bench/headroom.py runs all its rows, its oracles use the information that they claim to use, and a second call repeats
# no run. SCENE: made by make_scene.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
command -v python3 > /dev/null && [ -x "$gsfix" ] && [ -d "$scene" ] ||
    { echo "SKIPPED: no python3, program or scene"; exit 77; }
bench=$(cd "$(dirname "${BASH_SOURCE[0]}")/../bench" && pwd)
build=$(dirname "$gsfix")
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
fail() { echo "FAILED: $*"; exit 1; }

# With sensor noise of another seed it would be 44 dB.
"$build/oracle" cameras "$scene" cameras.json
"$build/make_scene" "$scene" --render cameras.json --out again
mkdir photos
number=0
for photo in "$scene"/images/*.png; do
    cp "$photo" "photos/$(printf %05d $number).png"
    number=$((number + 1))
done
"$gsfix" metrics again photos --which psnr --json > metrics.json
python3 - "$number" << 'PY' || fail "the scene's own cameras do not give its photos"
import json, sys
images = json.load(open("metrics.json"))["per_image"]
assert len(images) == int(sys.argv[1]), images
assert all(image["psnr"] is None or image["psnr"] > 60.0 for image in images), images  # null: identical
PY
cmp again/depth/00001.npy "$scene/truth/depth_002.npy" || fail "not the truth's depth"
cmp again/normal/00001.npy "$scene/truth/normal_002.npy" || fail "not the truth's normals"
"$build/make_scene" drift --views 3 --width 48 --height 32 --points 50 --drift 2
"$build/oracle" cameras drift drift.json
"$build/make_scene" drift --render drift.json --out drifted
cmp drifted/00002.png drift/images/frame_003.png || fail "not the exposure of the scene"
"$build/make_scene" named --scene hotel --views 3 --width 48 --height 32 --points 50
"$build/oracle" cameras named named.json
"$build/make_scene" named --render named.json --out again_named
cmp again_named/00001.png named/images/frame_002.png || fail "a scene of the benchmark renders differently"
for stops in 9 -1 nan x; do
    if "$build/make_scene" wrong --drift $stops 2> log; then fail "takes --drift $stops"; fi
    grep -q '^usage: ' log && [ ! -e wrong ] || fail "--drift $stops"
done
sed -i 's/"drift":2/"drift":9/' drift/truth/scene.json
if "$build/make_scene" drift --render drift.json --out wild 2> log; then fail "takes a drift of 9 stops"; fi
grep -q 'no valid "drift"' log || fail "does not name the drift"
if "$build/make_scene" "$scene" --render cameras.json --out again 2> log; then fail "writes into an existing folder"; fi
mkdir bare
if "$build/make_scene" bare --render cameras.json --out new 2> log; then fail "renders a folder that is no made scene"; fi
[ ! -e new ] || fail "images without a scene"

headroom() { # OUT SETTINGS ...
    python3 "$bench/headroom.py" "$scene" --out "$1" --build "$build" --seeds 1 --jobs 1 --common "--set $2" "${@:3}" \
        > log 2>&1 || { cat log; fail "headroom.py"; }
}
all_rows() {
    headroom out "rounds=1,windows=1,window_frames=6" --iterations 40 "$@" \
        --arm "early=--restorer oracle:truth --set first_round=5" --arm "other@$build/gsfix=--restorer none"
}
all_rows
cat > check.py << 'PY'
import glob, json, os, sys

sys.path.insert(0, sys.argv[1])
import headroom

folder, = glob.glob("out/runs/*/K3")
results = glob.glob(folder + "/rows/*/seed1/result.json")
rows = {path.split(os.sep)[-3]: json.load(open(path)) for path in results}
everywhere = {"truth", "densify", "ellipse", "interpolate", "capture", "early"}
oracles = everywhere | {"warp8", "carried", "masked", "blurred", "seen"}
assert set(rows) == oracles | {"none", "warp", "other"}, sorted(rows)
assert rows["other"]["psnr"] == rows["none"]["psnr"] and rows["other"]["program"], rows["other"]
for name in ("none", "warp", "other"):
    assert "rounds" not in rows[name] and rows[name]["psnr"] > 8.0, name
for name in oracles:
    sums, = rows[name]["rounds"]
    assert min(rows[name][figure] for figure in headroom.GAINS) > 8.0, (name, rows[name])
    assert 4 <= sums["frames"] <= 6 and sums["pixels"] == sums["frames"] * 96 * 64, (name, sums)
    assert 0 < sums["seen"] < sums["pixels"] and sums["render_error"] > 0.0, (name, sums)
    if name in everywhere:
        assert sums["restored_error"] == 0.0, name
    if name in everywhere or name == "blurred":
        assert sums["reached"] == sums["confidence"] == sums["pixels"], name
    if name == "seen":
        assert sums["reached"] == sums["confidence"] == sums["seen"], sums
    if name == "carried":
        assert 0.97 * sums["seen"] <= sums["reached"] == sums["confidence"] <= sums["seen"], sums
    if name in ("seen", "masked"):
        assert sums["reached_restored_error"] == 0.0 < sums["reached_render_error"], name
        assert abs(sums["restored_error"] - (sums["render_error"] - sums["reached_render_error"])) < 1e-6, name
    if name in ("masked", "warp8"):
        assert 0.0 < sums["confidence"] < sums["reached"] < sums["pixels"], name
    if name in oracles - {"early", "ellipse", "interpolate", "capture"}:  # the same model on the same path so far
        for key in ("frames", "seen", "render_error"):
            assert sums[key] == rows["truth"]["rounds"][0][key], (name, key)
sums, = rows["carried"]["rounds"]
assert sums["reached_restored_error"] < 0.3 * sums["reached_render_error"], sums
sums, = rows["blurred"]["rounds"]
assert 0.0 < sums["restored_error"] < 0.3 * sums["render_error"], sums
assert abs(rows["warp8"]["psnr"] - rows["warp"]["psnr"]) < 0.05, "8 bits change warp"

# the frames are at the paths reported
others, test = (headroom.read_cameras("%s/%s.json" % (folder, name)) for name in ("capture", "test"))
diameter = json.load(open(folder + "/split.json"))["diameter"]
for view, (distance, _) in zip(test, rows["capture"]["distances"]):
    nearest = min(headroom.distance(headroom.center_of(view), headroom.center_of(other)) for other in others)
    assert abs(nearest / diameter - distance) < 1e-6, (nearest, distance)
for name in ("ellipse", "interpolate"):
    assert rows[name]["rounds"][0]["render_error"] != rows["truth"]["rounds"][0]["render_error"], name
PY
python3 check.py "$bench" || { cat log; fail "rows that do not fit together"; }
[ ! -e "$(echo out/runs/*/K3/truth_on_paths/seed1)" ] || fail "the truth of a seed that is done is left behind"
cp out/headroom.csv before.csv
touch mark
all_rows
[ -z "$(find out/runs/*/K3 -newer mark)" ] && cmp before.csv out/headroom.csv || fail "a second call repeats runs"
all_rows --tables --base other
grep -q '^| none |.*| +0.00 | +0.00 | +0.00 | 0 % | 0 % | 1 |$' log || fail "gains are not over the base"
grep -q '^| other |.*|  |  |  |  |  | 1 |$' log || fail "gains of the base itself"
if (all_rows --base nothing) > /dev/null; then fail "takes a base that is no row"; fi
if (all_rows --sigma 3) > /dev/null; then fail "mixes runs of different settings"; fi
grep -q "begun with other settings" log || fail "does not name the cause"

# in a longer run the truth improves the result; two windows per round
headroom gain "rounds=2,windows=2,window_frames=8" --iterations 200 --rows none,truth
cat > gain.py << 'PY'
import glob, json
paths = (glob.glob("gain/runs/*/K3/rows/%s/seed1/result.json" % name)[0] for name in ("none", "truth"))
none, truth = (json.load(open(path)) for path in paths)
assert truth["psnr"] > none["psnr"] + 0.3, (none["psnr"], truth["psnr"])
assert len(truth["rounds"]) == 2 and all(12 <= sums["frames"] <= 16 for sums in truth["rounds"]), truth["rounds"]
assert truth["rounds"][1]["render_error"] < truth["rounds"][0]["render_error"], truth["rounds"]
PY
python3 gain.py || { cat log; fail "the truth does not help"; }
grep -q '^| truth | .* | 100 % | 100 % | 1 |$' gain/headroom.md || fail "the oracle does not convert all of its gain"

# as for real scenes: truth from a model of all photos
headroom model "rounds=1,windows=1,window_frames=6" --iterations 40 --truth model --model-iterations 60 --rows none,seen
cat > model.py << 'PY'
import glob, json
sums, = json.load(open(glob.glob("model/runs/*/K3/rows/seen/seed1/result.json")[0]))["rounds"]
assert 0.0 < sums["restored_error"] and 0.0 == sums["reached_restored_error"] < sums["reached_render_error"], sums
assert 0 < sums["seen"] == sums["reached"] < sums["pixels"], sums
PY
python3 model.py || { cat log; fail "truth by a model"; }
echo "further photos; 13 rows ray-traced, 2 from a model: as they should be"
