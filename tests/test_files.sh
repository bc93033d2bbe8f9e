#!/usr/bin/env bash
# test_files.sh GSFIX SCENE SCRATCH: ways in which gsfix could destroy files. Each is refused with one line before any work and
# leaves all files unchanged. Then the cases that must keep working. SCENE: made by make_scene.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch"
cd "$scratch"
scratch=$PWD
export OMP_WAIT_POLICY=passive
failures=0 cases=0 case=""
fail() { echo "FAILED: $case: $*"; failures=$((failures + 1)); }
tree() { # every file, link and folder with its content, except gsfix's manifest
    find . -name .gsfix -type d -prune -o -type f -printf '%p ' -exec sha256sum {} \; -o -type l -printf '%p -> %l\n' -o -type d -print -o -print |
        LC_ALL=C sort
}
run() { # COMMAND...: status in $status, output beside the case's folder
    status=0
    "$@" > ../stdout 2> ../stderr || status=$?
}
new() { # NAME: a fresh folder with its own copy of the scene
    case=$1
    cases=$((cases + 1))
    cd "$scratch"
    rm -rf now
    mkdir now
    cd now
    cp -r "$scene" S
}
refused() { # STATUS TEXT COMMAND...: prints one line with the text, quickly, and changes nothing
    local want=$1 text=$2
    shift 2
    tree > ../before
    local begin=$SECONDS
    run "$@"
    tree > ../after
    [ "$status" = "$want" ] || fail "status $status, not $want: $*"
    [ "$(grep -c . ../stderr)" = 1 ] || { fail "not one line: $*"; head -n 5 ../stderr; }
    grep -q -e "$text" ../stderr || { fail "does not say \"$text\""; cat ../stderr; }
    [ ! -s ../stdout ] || fail "prints to stdout"
    [ $((SECONDS - begin)) -lt 20 ] || fail "took $((SECONDS - begin)) s"
    cmp -s ../before ../after || { fail "files changed"; diff ../before ../after | head -n 5 || true; }
}
works() { # COMMAND...
    run "$@"
    [ "$status" = 0 ] || { fail "status $status: $*"; tail -n 3 ../stderr; }
}
same() { cmp -s "$1" "$2" || fail "$1 and $2 differ"; }
quick=(--views 3 --iterations 4 --max-size 48 --checkpoint-every 2)
repair=(--compare --restorer warp --set rounds=1,windows=1,window_frames=4,first_round=1,last_round=3)
fix() { timeout -k 5 120 "$gsfix" fix "$@" "${quick[@]}"; }

# ---- fixtures: splats, the output folder of a run with repair, a path
cp -r "$scene" S
"$gsfix" fix S --out made "${quick[@]}" "${repair[@]}" --also spz > /dev/null 2>&1 || { echo "FAILED: no run to start from"; exit 1; }
"$gsfix" path S --views 3 --frames 4 --out path.json > /dev/null
view=$(basename "$(ls made/test/*.png)")
splats=$scratch/made/splats.ply

# ---- outputs among inputs
new "OUT is the scene";            refused 1 "^gsfix fix: S: " fix S --out S
new "OUT is the scene, by a link"; ln -s S L; refused 1 "^gsfix fix: L: " fix S --out L
new "OUT is the photo folder";     refused 1 "S/images" fix S --out S/images
new "OUT is the model's folder";   refused 1 "S/sparse/0" fix S --out S/sparse/0
new "OUT is the folder of masks";  cp -r S/images M; refused 1 "^gsfix fix: M" fix S --out M --masks M
transforms() { # FOLDER: photos of S/images there, listed by a transforms.json in T
    mkdir -p "T/$1"
    cp S/images/*.png "T/$1/"
    local x=0 photo comma=""
    printf '{"fl_x":90,"fl_y":90,"cx":48,"cy":32,"w":96,"h":64,"frames":[' > T/transforms.json
    for photo in T/"$1"/*.png; do
        printf '%s{"file_path":"%s","transform_matrix":[[1,0,0,%d],[0,1,0,0.%d],[0,0,1,4],[0,0,0,1]]}' "$comma" "${photo#T/}" $x $((x * x)) >> T/transforms.json
        comma=, x=$((x + 1))
    done
    printf ']}' >> T/transforms.json
}
new "photos in OUT/test";          transforms test; refused 1 "^gsfix fix: T" fix T --out T
new "photos in OUT/report/without"; transforms report/without; refused 1 "^gsfix fix: T" fix T --out T "${repair[@]}"
new "photos in OUT/test, the scene elsewhere"; transforms test; mkdir U; mv T/transforms.json U; sed -i 's,"test/,"../T/test/,g' U/transforms.json
refused 1 "" fix U --out T
new "photos in OUT/test, an absolute path to the file"; transforms test; refused 1 "T" fix "$PWD/T/transforms.json" --out ./T/../T
new "render over photos";          refused 1 "S/images" "$gsfix" render "$splats" --scene S --out S/images
new "render into the scene";       refused 1 "^gsfix render: S: " "$gsfix" render "$splats" --scene S --out S
new "render where the splats are"; mkdir P; cp "$splats" P; refused 1 "^gsfix render: P: " "$gsfix" render P/splats.ply --scene S --out P
new "filter over the model";       refused 1 "^gsfix filter: S: " "$gsfix" filter S --out S
new "filter over a linked model";  mkdir S2; ln -s ../S/sparse S2/sparse; refused 1 "S2/sparse" "$gsfix" filter S --out S2
new "masks over photos";           refused 1 "S/images" "$gsfix" masks S --views 3 --model "$splats" --out S/images
new "restore over its frames";     refused 1 "^gsfix restore: S/images: " "$gsfix" restore S/images --restorer none --out S/images
new "restore into a job's frames"; mkdir J; cp -r S/images J/frames; refused 1 "J/frames" "$gsfix" restore J --restorer none --out J/frames
new "restore over the references"; mkdir R; cp S/images/"$view" R/ref.png; refused 1 "^gsfix restore: R: " "$gsfix" restore S/images --refs R/ref.png --restorer none --out R
new "path over a photo";           refused 1 "S/images/$view" "$gsfix" path S --views 3 --out S/images/"$view"
new "path over the model";         refused 1 "is there already" "$gsfix" path S --views 3 --out S/sparse/0/images.bin

# ---- foreign files under output names
for name in splats.ply metrics.json report.html checkpoint dit.checkpoint "test/$view"; do
    new "a file at $name"; mkdir -p "OUT/$(dirname "$name")"; echo mine > "OUT/$name"
    refused 1 "OUT/$name" fix S --out OUT
    refused 1 "OUT/$name" fix S --out OUT --restart
    refused 1 "OUT/$name" fix S --out OUT --resume
done
for name in fixed/round1_window1_00002.png report/round7_window1_render.png "report/without/$view"; do
    new "a file at $name"; mkdir -p "OUT/$(dirname "$name")"; echo mine > "OUT/$name"; refused 1 "OUT/$name" fix S --out OUT "${repair[@]}"
done
new "a file at splats.spz";  mkdir OUT; echo mine > OUT/splats.spz; refused 1 "OUT/splats.spz" fix S --out OUT --also spz
new "a link at splats.ply";  mkdir OUT; echo mine > mine; ln -s ../mine OUT/splats.ply; refused 1 "OUT/splats.ply" fix S --out OUT
new "a hard link at splats.ply"; mkdir OUT; echo mine > mine; ln mine OUT/splats.ply; refused 1 "OUT/splats.ply" fix S --out OUT
new "a folder at metrics.json"; mkdir -p OUT/metrics.json; echo mine > OUT/metrics.json/mine; refused 1 "OUT/metrics.json" fix S --out OUT
new "a FIFO at report.html"; mkdir OUT; mkfifo OUT/report.html; refused 1 "OUT/report.html" fix S --out OUT
for command in "render $splats --scene S" "masks S --views 3 --model $splats"; do
    new "a file in the way of ${command%% *}"; mkdir OUT; echo mine > "OUT/$view"
    refused 1 "OUT/$view" "$gsfix" $command --out OUT
done
new "a depth in the way";    mkdir -p OUT/depth; echo mine > "OUT/depth/00002.npy"
refused 1 "OUT/depth/00002.npy" "$gsfix" render "$splats" --path ../path.json --out OUT --depth
new "a model in the way";    mkdir -p S2/sparse/0; echo mine > S2/sparse/0/cameras.bin; refused 1 "S2/sparse/0/cameras.bin" "$gsfix" filter S --out S2
new "a frame in the way";    mkdir OUT; echo mine > "OUT/$view"; refused 1 "OUT/$view" "$gsfix" restore S/images --restorer none --out OUT
new "a confidence in the way"; mkdir -p OUT/confidence; echo mine > "OUT/confidence/$view"; refused 1 "OUT/confidence/$view" "$gsfix" restore S/images --restorer none --out OUT
new "path over a file";      echo mine > p.json; refused 1 "p.json" "$gsfix" path S --views 3 --out p.json
new "path over a link";      echo mine > mine; ln -s mine p.json; refused 1 "p.json" "$gsfix" path S --views 3 --out p.json
new "path over a dangling link"; ln -s nowhere p.json; refused 1 "p.json" "$gsfix" path S --views 3 --out p.json
new "features over a file";  echo mine > f.safetensors; refused 1 "f.safetensors" fix S --out OUT --restorer dit:none --save-features f.safetensors
new "features over weights"; echo mine > S/f; refused 1 "S/f" "$gsfix" restore S/images --out OUT --restorer dit:none --save-features S/f

# ---- links and files where folders are needed
for name in test fixed report report/without; do
    new "a link at OUT/$name"; mkdir -p OUT docs; [ $name = test ] && rm -r docs && cp -r S/images docs; echo mine > docs/mine
    mkdir -p "$(dirname OUT/$name)"; ln -s "$PWD/docs" OUT/$name
    refused 1 "OUT/$name" fix S --out OUT "${repair[@]}"
done
new "a link at OUT/.gsfix";  mkdir OUT docs; echo mine > docs/manifest; ln -s ../docs OUT/.gsfix; refused 1 "OUT/.gsfix" fix S --out OUT
new "a link at OUT/depth";   mkdir OUT docs; ln -s ../docs OUT/depth; refused 1 "OUT/depth" "$gsfix" render "$splats" --scene S --out OUT --depth
new "a link at OUT/confidence"; mkdir OUT docs; ln -s ../docs OUT/confidence; refused 1 "OUT/confidence" "$gsfix" restore S/images --restorer none --out OUT
new "a file at OUT/test";    mkdir OUT; echo mine > OUT/test; refused 1 "OUT/test" fix S --out OUT
new "OUT is a file";         echo mine > OUT; refused 1 "OUT" fix S --out OUT
new "OUT is below a file";   echo mine > OUT; refused 1 "OUT" fix S --out OUT/a/b
new "OUT is a link to nothing"; ln -s nowhere OUT; refused 1 "OUT" fix S --out OUT
new "OUT cannot be made";    refused 1 "/proc/no" fix S --out /proc/no/such
new "path into no folder";   refused 1 "no such folder" "$gsfix" path S --views 3 --out no/path.json
if [ "$(id -u)" != 0 ]; then
    new "OUT cannot be written"; mkdir OUT; chmod 555 OUT; refused 1 "OUT" fix S --out OUT; chmod 755 OUT
    new "OUT/test cannot be written"; mkdir -p OUT/test; chmod 555 OUT/test; refused 1 "OUT/test" fix S --out OUT; chmod 755 OUT/test
fi
new "a foreign .gsfix";      mkdir -p OUT/.gsfix; echo mine > OUT/.gsfix/notes; refused 1 "OUT/.gsfix/notes" fix S --out OUT; [ "$(cat OUT/.gsfix/notes)" = mine ] || fail "lost"
new "a foreign manifest";    mkdir -p OUT/.gsfix; echo mine > OUT/.gsfix/manifest; refused 1 "manifest" fix S --out OUT; [ "$(cat OUT/.gsfix/manifest)" = mine ] || fail "lost"
new "a name that is too long"; mkdir -p L; refused 1 "L" fix S --out "L/$(printf 'x%.0s' $(seq 300))"

# ---- files of gsfix that were changed since; checkpoints
edited() { cp -r ../made OUT; }
new "an edited picture";     edited; echo mine >> "OUT/test/$view"; refused 1 "OUT/test/$view" fix S --out OUT --restart
new "an edited report";      edited; sed -i s/PSNR/mine/ OUT/report.html; refused 1 "OUT/report.html" fix S --out OUT --restart
new "splats put in place";   edited; cp OUT/splats.spz OUT/splats.ply; refused 1 "OUT/splats.ply" fix S --out OUT --restart
new "a picture of the same size"; edited; size=$(stat -c %s "OUT/test/$view"); head -c "$size" /dev/zero > "OUT/test/$view"; refused 1 "OUT/test/$view" fix S --out OUT --restart
new "an output that became a link"; edited; mv "OUT/splats.ply" mine.ply; ln -s ../mine.ply OUT/splats.ply; refused 1 "OUT/splats.ply" fix S --out OUT --restart
new "a checkpoint is there"; edited; refused 1 "OUT holds the checkpoint of a run at step 4 of 4: --resume goes on, --restart begins anew" fix S --out OUT "${repair[@]}"
new "resume with other settings"; edited; refused 1 "made with regularize" fix S --out OUT "${repair[@]}" --also spz --resume --regularize off
new "resume after a photo was replaced"; edited; cp "S/images/frame_003.png" "S/images/frame_002.png"
refused 1 "S/images/frame_002.png" fix S --out OUT "${repair[@]}" --also spz --resume
new "resume after a held-out photo was replaced"; edited; cp "S/images/frame_003.png" "S/images/$view"
refused 1 "S/images/$view" fix S --out OUT "${repair[@]}" --also spz --resume
new "resume after the points changed"; edited; for f in cameras images points3D; do [ ! -e S/sparse/0/$f.bin ] || file=S/sparse/0/$f.bin; done
printf '\377' | dd of=$file bs=1 seek=41 conv=notrunc 2> /dev/null
refused 1 "$file" fix S --out OUT "${repair[@]}" --also spz --resume
new "resume after the masks changed"; "$gsfix" masks S --views 3 --model "$splats" --max-size 48 --out M > /dev/null 2>&1; works fix S --out OUT --masks M
rm M/"$view"; printf 'P5 48 32 255\n%1536s' x > M/"$view"; refused 1 "M/$view" fix S --out OUT --masks M --resume
new "resume after the names changed"; printf 'frame_002.png\nframe_004.png\n' > names; works "$gsfix" fix S --views names --iterations 2 --max-size 48 --out OUT
printf 'frame_004.png\nframe_002.png\n' > names; refused 1 "names" "$gsfix" fix S --views names --iterations 2 --max-size 48 --out OUT --resume
new "usage"; refused 2 "exclude each other" fix S --out OUT --resume --restart

# ---- two runs at once, and a lock that is released when its process dies
new "a second run"
"$gsfix" fix S --out OUT --views 3 --iterations 100000 --max-size 48 > /dev/null 2> ../first &
first=$!
for _ in $(seq 300); do grep -q "training views" ../first && break; sleep 0.1; done
run fix S --out OUT
[ "$status" = 1 ] && grep -q "OUT: another gsfix is at work there" ../stderr && [ "$(grep -c . ../stderr)" = 1 ] || fail "fix: $(cat ../stderr)"
run "$gsfix" render "$splats" --scene S --out OUT
[ "$status" = 1 ] && grep -q "another gsfix" ../stderr || fail "render: $(cat ../stderr)"
{ kill -9 $first; wait $first; } 2> /dev/null || true
works fix S --out OUT --restart

# ---- restorers that misbehave
exec_fix() { fix S --out OUT --restorer "exec:$1" --set rounds=1,windows=2,window_frames=4,first_round=1,last_round=3; }
copy='cp "$1"/frames/*.png "$1"/out/; true' # the job folder is the command's last argument
hostile() { # NAME TEXT SCRIPT: exit status 1, the folder docs as it was
    new "a restorer that $1"
    mkdir docs; echo mine > docs/mine; cp S/images/*.png docs/
    printf '#!/bin/sh\n%s\n' "$3" > r.sh; chmod +x r.sh
    tree | grep docs > ../before
    run exec_fix "DOCS=$PWD/docs $PWD/r.sh"
    tree | grep docs | grep -v 'OUT/' > ../after
    [ "$status" = 1 ] && [ "$(grep -c '^gsfix' ../stderr)" = 1 ] || fail "status $status"
    grep -q "$2" ../stderr || { fail "does not say \"$2\""; tail -n 2 ../stderr; }
    same ../before ../after
}
hostile "makes out/ a link" "/out: a link or a file is where a folder is needed" 'cp "$1"/frames/*.png "$DOCS"/ && rm "$DOCS"/0*.png; rmdir "$1"/out; ln -s "$DOCS" "$1"/out'
hostile "makes confidence/ a link" "/confidence: a link or a file" "$copy"'; rmdir "$1"/confidence; ln -s "$DOCS" "$1"/confidence'
hostile "puts a link in the place of its folder" "No such file\|a link\|was not written" 'rm -r "$1"; ln -s "$DOCS" "$1"'
hostile "makes frames/ a link and goes on" "/frames: a link or a file" "$copy"'; rm -r "$1"/frames; ln -s "$DOCS" "$1"/frames'
new "a restorer that leaves links"; mkdir docs; echo mine > docs/mine
works exec_fix "$copy; ln -s $PWD/docs \"\$1\"/out/docs; ln -s $PWD/docs/mine \"\$1\"/m; mkdir -p \"\$1\"/deep/er; ln -s $PWD/docs \"\$1\"/deep/er/; true"
[ "$(cat docs/mine)" = mine ] || fail "lost what a link points to"
[ -z "$(find OUT -name 'job*')" ] || fail "the job folder stays"
new "a folder named job"; mkdir -p OUT/job/frames; echo mine > OUT/job/mine; echo mine > OUT/job/frames/00000.png; works exec_fix "$copy"
[ "$(cat OUT/job/mine OUT/job/frames/00000.png)" = "mine
mine" ] || fail "lost"
new "restore a job where it lies"; cp -r ../made OUT; run fix S --out OUT --restart "${repair[@]/warp/exec:exit 5}"; job=$(ls -d OUT/job-*)
[ "$status" = 1 ] && grep -q "kept: .*/$job)" ../stderr || fail "the line does not name the job's folder: $(cat ../stderr)"
(cd "$job" && tree) > ../before
works "$gsfix" restore "$job" --restorer "exec:$copy" --out OUT
(cd "$job" && tree) > ../after
same ../before ../after

# ---- processes started by a restorer end with the run
gone() { # PID: within two seconds
    for _ in $(seq 20); do
        [ -e "/proc/$1" ] && ! grep -q '^State:.*Z' "/proc/$1/status" 2> /dev/null || return 0
        sleep 0.1
    done
    return 1
}
for signal in KILL INT; do
    new "gsfix ended by SIG$signal while a restorer works"
    printf '#!/bin/sh\nsleep 1000 &\nsh -c "sleep 1000 & echo \\$! > %s/pids; wait" &\necho $! >> %s/pids2\nwait\n' "$PWD" "$PWD" > r.sh; chmod +x r.sh
    "$gsfix" fix S --out OUT "${quick[@]}" --restorer "exec:$PWD/r.sh" --set rounds=1,windows=1,window_frames=4,first_round=1,last_round=3 > /dev/null 2>&1 &
    pid=$!
    for _ in $(seq 300); do [ -s pids ] && [ -s pids2 ] && break; sleep 0.1; done
    [ -s pids ] || fail "the restorer did not start"
    { kill -$signal $pid; wait $pid; } 2> /dev/null || true
    for child in $(cat pids pids2); do gone "$child" || { fail "process $child lives on"; kill -9 "$child"; }; done
    works fix S --out OUT --restart # the lock is free
done

# ---- full disks, simulated by a file size limit
new "no room for the checkpoint" # except the splats
room=$(( $(stat -c %s ../made/splats.ply) / 1024 + 20 ))
[ $((room * 1024)) -lt "$(stat -c %s ../made/checkpoint)" ] || fail "the test needs a larger checkpoint"
(ulimit -f $room; run fix S --out OUT "${repair[@]}"; echo $status > ../status)
[ "$(cat ../status)" = 0 ] || fail "status $(cat ../status): $(tail -n 1 ../stderr)"
[ "$(grep -c "warning: no checkpoint" ../stderr)" = 1 ] || fail "not one warning"
same OUT/splats.ply ../made/splats.ply
[ ! -e OUT/checkpoint ] && [ "$(find OUT -name '*new*' -o -name '*tmp*' | wc -l)" = 0 ] || fail "something is left"
new "no room for the splats"; cp -r ../made OUT; cp OUT/checkpoint kept
(ulimit -f 20; run fix S --out OUT "${repair[@]}" --also spz --resume; echo $status > ../status)
[ "$(cat ../status)" = 1 ] && [ "$(grep -c '^gsfix' ../stderr)" = 1 ] && grep -q "^gsfix fix: OUT/splats.ply: cannot be written" ../stderr || fail "$(tail -n 1 ../stderr)"
same OUT/checkpoint kept; same OUT/splats.ply ../made/splats.ply
[ -z "$(find OUT -name '*new*' -o -name '*tmp*')" ] || fail "a temporary is left"
new "Ctrl-C and no room"
(ulimit -f 20; exec "$gsfix" fix S --out OUT --views 3 --iterations 100000 --max-size 48 > /dev/null 2> ../stderr) &
pid=$!
for _ in $(seq 300); do grep -q "step" ../stderr && break; sleep 0.1; done
kill -INT $pid; status=0; wait $pid || status=$?
[ "$status" = 1 ] && grep -q "stopped at step .* without a checkpoint: OUT/checkpoint: cannot be written" ../stderr || fail "$(tail -n 1 ../stderr)"

# ---- cases that must keep working
new "begin anew"; cp -r ../made OUT; echo mine > OUT/notes.txt; echo mine > OUT/test/notes.txt; echo mine > OUT/fixed/mine.png; mkdir OUT/report/mine
works fix S --out OUT "${repair[@]}" --also spz --restart
for file in splats.ply splats.spz "test/$view" fixed/round1_window1_00001.png; do same OUT/$file ../made/$file; done
[ "$(cat OUT/notes.txt OUT/test/notes.txt OUT/fixed/mine.png | sort -u)" = mine ] && [ -d OUT/report/mine ] || fail "lost"
works fix S --out OUT --restart # without repair: the earlier run's frames and splats.spz are stale
[ "$(find OUT/fixed -type f)" = OUT/fixed/mine.png ] && [ ! -e OUT/splats.spz ] && [ ! -e "OUT/report/without/$view" ] || fail "stale files stay"
[ "$(cat OUT/notes.txt)" = mine ] || fail "lost"
new "resume"; cp -r ../made OUT; rm OUT/splats.ply; works fix S --out OUT "${repair[@]}" --also spz --resume; same OUT/splats.ply ../made/splats.ply
new "resume where the scene has moved"; cp -r ../made OUT; mv S elsewhere; works fix elsewhere --out OUT "${repair[@]}" --also spz --resume
new "a copy of OUT"; cp -r ../made copy; works fix S --out copy --restart "${repair[@]}"
new "OUT is a link"; mkdir there; ln -s there OUT; works fix S --out OUT; works fix S --out OUT --restart; [ -s there/splats.ply ] || fail "no splats"
new "OUT in the scene"; works fix S --out S/out; works fix S --out S/out --restart
new "a cut line in the manifest"; cp -r ../made OUT; printf '0123456789abcdef 12 fix repo' >> OUT/.gsfix/manifest; works fix S --out OUT --restart
[ "$(grep -c "repo[^r]*$" OUT/.gsfix/manifest)" = 0 ] || fail "the cut line stays"
new "a temporary is left"; cp -r ../made OUT; echo cut > OUT/.gsfix/new; works fix S --out OUT --restart; [ ! -e OUT/.gsfix/new ] || fail "it stays"
new "render twice"; works "$gsfix" render "$splats" --scene S --out OUT --depth --alpha; echo mine > OUT/mine.png; works "$gsfix" render "$splats" --path ../path.json --out OUT
[ "$(ls OUT/*.png | wc -l)" = 5 ] && [ -z "$(ls OUT/depth OUT/alpha | grep png)" ] && [ "$(cat OUT/mine.png)" = mine ] || fail "stale frames: $(ls OUT)"
new "render into a run's folder"; cp -r ../made OUT; works "$gsfix" render ../made/splats.ply --scene S --out OUT; [ -s "OUT/test/$view" ] && [ -s OUT/splats.ply ] || fail "removed what fix wrote"
new "filter twice"; works "$gsfix" filter S --views 3 --out S2; ln -s ../S/images S2/images; works "$gsfix" filter S --views 4 --out S2; works "$gsfix" info S2
new "masks twice"; works "$gsfix" masks S --views 3 --model "$splats" --out M; works "$gsfix" masks S --views 4 --model "$splats" --out M
new "a path to stdout"; "$gsfix" path S --views 3 --frames 4 --out /dev/stdout 2> ../stderr | cat > ../path && grep -q '"w2c"\|"frames"' ../path || fail "no path"
new "a path nowhere"; works "$gsfix" path S --views 3 --out /dev/null
new "a refused run leaves nothing"; run fix S --out OUT --masks nothing; [ "$status" = 1 ] && [ ! -e OUT ] || fail "OUT is there: $(ls -A OUT)"
run fix S --out a/b/c/ --masks nothing; [ "$status" = 1 ] && [ ! -e a ] || fail "a is there"
new "views of almost one name"; transforms a; mv T/a/frame_001.png T/a/b.png; mv T/a/frame_002.png T/a_b.png; mv T/a/frame_003.png T/a_b.jpg.png
cp T/a_b.png T/a_b.jpg; sed -i 's,a/frame_001.png,a/b.png,;s,a/frame_002.png,a_b.png,;s,a/frame_003.png,a_b.jpg.png,;s,a/frame_004.png,a_b.jpg,' T/transforms.json
works "$gsfix" render "$splats" --scene T --out OUT; [ "$(ls OUT/*.png | wc -l)" = "$(grep -o file_path T/transforms.json | wc -l)" ] || fail "views share a picture: $(ls OUT)"

# ---- make_scene and make_model
folder=$(dirname "$gsfix")
new "a scene over a scene"; rm -r S/truth; refused 1 "not written by make_scene" "$folder/make_scene" S --views 4 --width 32 --height 32
mkdir E; works "$folder/make_scene" E --views 4 --width 32 --height 32 --points 40; works "$folder/make_scene" E --views 5 --width 32 --height 32 --points 40
if [ -x "$folder/make_model" ]; then
    new "a model over a model"; mkdir -p M/scheduler; echo mine > M/scheduler/scheduler_config.json
    refused 1 "not of make_model's making" "$folder/make_model" M --size tiny --parts scheduler
    works "$folder/make_model" N --size tiny --parts scheduler; works "$folder/make_model" N --size tiny --parts scheduler
fi

[ "$failures" = 0 ] || { echo "$failures failures in $cases cases"; exit 1; }
echo "$cases cases, $SECONDS s: every foreign file as it was"
