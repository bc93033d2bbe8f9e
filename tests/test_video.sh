#!/usr/bin/env bash
# test_video.sh GSFIX SCENE SCRATCH: --video of gsfix render, restore and fix: animated PNG and page, byte by byte; ffmpeg, a script
# in its place that fails in every way, and the real one where it is installed. SCENE: made by make_scene.
set -euo pipefail
gsfix=$1 scene=$2 scratch=$3
[ -x "$gsfix" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch/bin"
cd "$scratch"
export OMP_WAIT_POLICY=passive
failures=0
fail() { echo "FAILED: $*"; failures=$((failures + 1)); }
expect() { # STATUS COMMAND...
    local want=$1 status=0
    shift
    timeout -k 5 120 "$@" > stdout 2> stderr || status=$?
    [ "$status" = "$want" ] || { fail "status $status, not $want: $*"; tail -n 3 stderr; }
}
says() { # STATUS TEXT COMMAND...: after its progress, one line with the text
    local text=$2
    expect "$1" "${@:3}"
    grep -v '^ *[0-9]* %' stderr > said || true
    [ "$(grep -c . said)" = 1 ] || { fail "not one line: ${*:3}"; head -n 5 said; }
    grep -q -e "$text" said || { fail "does not say \"$text\": ${*:3}"; cat said; }
}
clean() { # OUT FILE: nothing is left of an unfinished video
    [ ! -e "$2" ] || fail "$2 is there"
    [ ! -e "$1/.gsfix/draft" ] || fail "$1/.gsfix/draft is there"
}
gone() { # FILE with a process's number: it has ended
    for i in $(seq 100); do [ -d "/proc/$(cat "$1")" ] || return 0; sleep 0.05; done
    fail "ffmpeg is still there"
}

small=(--views 3 --iterations 20 --max-size 48)
warp=(--restorer warp --set rounds=1,windows=1,window_frames=5,first_round=1,last_round=3)
expect 0 "$gsfix" fix "$scene" --out made "${small[@]}"
expect 0 "$gsfix" path "$scene" --views 3 --max-size 47 --frames 7 --out path.json # 47 x 31: ffmpeg gets 48 x 32
render=("$gsfix" render made/splats.ply --path path.json --out r)

# ---- built by gsfix itself
cat > check.py <<'PYTHON'
import base64, json, re, struct, sys, zlib
def chunks(path):
    data = open(path, "rb").read()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, found = 8, []
    while at < len(data):
        size, kind = struct.unpack(">I4s", data[at:at + 8])
        body = data[at + 8:at + 8 + size]
        assert struct.unpack(">I", data[at + 8 + size:at + 12 + size])[0] == zlib.crc32(kind + body), (path, kind)
        found.append((kind, body))
        at += 12 + size
    assert found[-1] == (b"IEND", b"")
    return found
def pixels(found, kind, skip):
    return zlib.decompress(b"".join(body[skip:] for k, body in found if k == kind))
def png(path, fps, frames):
    found = chunks(path)
    assert [k for k, _ in found[:4]] == [b"IHDR", b"acTL", b"fcTL", b"IDAT"]
    assert found[1][1] == struct.pack(">II", len(frames), 0)
    numbers = [struct.unpack(">I", body[:4])[0] for k, body in found if k in (b"fcTL", b"fdAT")]
    assert numbers == list(range(len(numbers)))
    starts = [i for i, c in enumerate(found) if c[0] == b"fcTL"] + [len(found) - 1]
    assert len(starts) == len(frames) + 1
    for n, frame in enumerate(frames):
        single, control = chunks(frame), found[starts[n]][1]
        assert single[0] == found[0]
        assert control[4:12] == single[0][1][:8] and control[12:20] == bytes(8), "frame %d" % n
        assert struct.unpack(">HHBB", control[20:]) == (1, fps, 0, 0)
        mine = pixels(found[starts[n]:starts[n + 1]], b"fdAT" if n else b"IDAT", 4 if n else 0)
        assert mine == pixels(single, b"IDAT", 0), "frame %d" % n
def page(path, fps, count):
    text = open(path, encoding="utf-8").read()
    data = json.loads(re.search(r'<script type="application/json" id=data>(.*?)</script>', text, re.S).group(1))
    assert data["fps"] == fps and len(data["frames"]) == count
    assert all(base64.b64decode(f)[:2] == b"\xff\xd8" for f in data["frames"])
    assert not re.search(r'(src|href)="?http', text)
if sys.argv[1] == "png": png(sys.argv[2], int(sys.argv[3]), sys.argv[4:])
else: page(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
PYTHON
check() { ! command -v python3 > /dev/null || python3 check.py "$@" || fail "check.py ${*:1:3}"; }
expect 0 "${render[@]}" --video flight.png --json
grep -q '"video":"flight.png"' stdout || fail "--json without the video"
check png flight.png 24 r/0*.png
expect 0 "${render[@]}" --video r/flight.html --fps 12 --threads 1
check page r/flight.html 12 7
cp r/flight.html before.html
expect 0 "${render[@]}" --video r/flight.html --fps 12 --threads 3 # replaces its own
cmp -s before.html r/flight.html || fail "another page with three threads"
expect 0 "${render[@]}"
[ ! -e r/flight.html ] && [ -e flight.png ] || fail "a stale video in OUT, or none beside it"
expect 0 "$gsfix" render made/splats.ply --scene "$scene" --views 3 --max-size 47 --restorer warp --out filtered --video filtered.PNG
check png filtered.PNG 24 filtered/*.png
expect 0 "$gsfix" restore r --restorer none --out restored --video restored/clip.png
check png restored/clip.png 24 restored/0*.png
expect 0 "$gsfix" path "$scene" --views 3 --max-size 32 --frames 2 --out small.json # cameras of two sizes: centred
{ head -n -1 path.json; printf ',\n'; sed 1d small.json; } > mixed.json
expect 0 "$gsfix" render made/splats.ply --path mixed.json --out mixed --video mixed.html
grep -q '<canvas id=view width=47 height=31>' mixed.html || fail "the video is not as large as the largest frame"
expect 0 "$gsfix" fix "$scene" --out fixed "${small[@]}" "${warp[@]}" --video fixed/repaired.html
check page fixed/repaired.html 24 "$(ls fixed/fixed | wc -l)"
expect 0 "$gsfix" fix "$scene" --out fixed "${small[@]}" "${warp[@]}" --resume --video fixed/repaired.png
check png fixed/repaired.png 24 fixed/fixed/*.png

# ---- refused before any work
says 2 "one of .mp4, .webm, .png and .html" "${render[@]}" --video flight.avi
says 2 "only with --video" "${render[@]}" --fps 10
says 2 "there is none" "$gsfix" fix "$scene" --out f "${small[@]}" --video f.mp4
echo mine > mine.png
says 1 "is there already, and not replaced" "${render[@]}" --video mine.png
says 1 "another file of this name" "${render[@]}" --video r/00002.png
says 1 "no such folder" "${render[@]}" --video nowhere/flight.png
says 1 "needs ffmpeg, which is not in PATH" env PATH="$PWD" "$gsfix" render made/splats.ply --path path.json --out n --video n.mp4
[ "$(cat mine.png)" = mine ] && [ ! -e f ] && [ ! -e n ] && [ ! -e n.mp4 ] || fail "files of refused runs"

# ---- in place of ffmpeg: what it is told by FAKE
cat > bin/ffmpeg <<'SH'
#!/bin/sh
for last in "$@"; do :; done
echo "$*" > "$FAKE_DIR/arguments"
echo $$ > "$FAKE_DIR/pid"
case $FAKE in
    works) cat > "$last" ;;
    fails) cat > /dev/null; echo "Unknown encoder" >&2; echo "more" >&2; exit 3 ;;
    early) echo "no thanks" >&2; exit 4 ;;
    short) head -c 100 > "$last" ;;
    killed) echo partial > "$last"; kill -9 $$ ;;
    writes_nothing) cat > /dev/null ;;
    hangs) echo partial > "$last"; exec sleep 1000 ;;
    loud) head -c 3000000 /dev/zero | tr '\0' 'x' >&2; cat > "$last" ;;
esac
SH
chmod +x bin/ffmpeg
export FAKE_DIR=$PWD
prefix=()
run_as() { prefix=(env "FAKE=$1" "PATH=$FAKE_DIR/bin:$PATH"); }
run_as works
expect 0 "${prefix[@]}" "${render[@]}" --video r/flight.mp4
[ "$(wc -c < r/flight.mp4)" = $((7 * 48 * 32 * 3)) ] || fail "ffmpeg got $(wc -c < r/flight.mp4) bytes"
clean r nothing
grep -q -e "-video_size 48x32 -framerate 24 " arguments && grep -q -e "-f mp4 " arguments || fail "arguments: $(cat arguments)"
grep -q " render flight.mp4$" r/.gsfix/manifest || fail "the video is not in the manifest"
expect 0 "${prefix[@]}" "${render[@]}" --video r/flight.mp4 --threads 1
expect 0 "${prefix[@]}" "$gsfix" fix "$scene" --out fixed "${small[@]}" "${warp[@]}" --resume --video repaired.webm
[ "$(wc -c < repaired.webm)" = $(($(ls fixed/fixed | wc -l) * 48 * 32 * 3)) ] || fail "ffmpeg got $(wc -c < repaired.webm) bytes"
cp r/flight.mp4 before.mp4
run_as loud
expect 0 "${prefix[@]}" "${render[@]}" --video loud.mp4
cmp -s loud.mp4 before.mp4 || fail "another video"
big=("$gsfix" render made/splats.ply --scene "$scene" --out b --video b.mp4) # more than a pipe holds
run_as fails; says 1 "^gsfix render: --video b.mp4: ffmpeg ended with status 3: Unknown encoder$" "${prefix[@]}" "${big[@]}"; clean b b.mp4
run_as early; says 1 "ffmpeg ended with status 4: no thanks$" "${prefix[@]}" "${big[@]}"; clean b b.mp4
run_as killed; says 1 "ffmpeg was ended by signal 9" "${prefix[@]}" "${big[@]}"; clean b b.mp4
run_as short; says 1 "ffmpeg ended before it had taken everything" "${prefix[@]}" "${big[@]}"; clean b b.mp4
run_as writes_nothing; says 1 "draft" "${prefix[@]}" "${big[@]}"; clean b b.mp4

# ---- stopped and killed
run_as hangs
for how in INT KILL; do
    rm -f pid
    "${prefix[@]}" "${big[@]}" > stdout 2> stderr &
    run=$!
    for i in $(seq 200); do [ -s pid ] && [ -s b/.gsfix/draft ] && break; sleep 0.05; done
    [ -s b/.gsfix/draft ] || fail "ffmpeg was not started"
    sleep 0.2
    kill -$how $run
    status=0
    wait $run || status=$?
    if [ $how = INT ]; then
        [ $status = 1 ] || fail "status $status after Ctrl-C"
        [ "$(grep -vc '^ *[0-9]* %' stderr)" = 1 ] || { fail "not one line after Ctrl-C"; cat stderr; }
        clean b b.mp4
    fi
    gone pid
done
[ -e b/.gsfix/draft ] || fail "killed, and the draft is not there: the test tests nothing"
run_as works
expect 0 "${prefix[@]}" "${big[@]}"
clean b nothing
[ -s b.mp4 ] || fail "no video after a killed run"

# ---- the real one
if command -v ffmpeg > /dev/null && command -v ffprobe > /dev/null; then
    for kind in mp4 webm; do
        expect 0 "${render[@]}" --video real.$kind --fps 10
        got=$(ffprobe -v error -count_frames -show_entries stream=width,height,nb_read_frames,r_frame_rate,pix_fmt -of csv=p=0 real.$kind)
        [ "$got" = "48,32,yuv420p,10/1,7" ] || fail "$kind: $got"
    done
    got=$(ffprobe -v error -f apng -count_frames -show_entries stream=width,height,nb_read_frames -of csv=p=0 flight.png)
    [ "$got" = "47,31,7" ] || fail "flight.png: $got"
    echo "with $(ffmpeg -version | head -n 1 | cut -d ' ' -f 1-3)"
fi
[ $failures = 0 ] || exit 1
echo "all passed"
