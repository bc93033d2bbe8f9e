#!/usr/bin/env bash
# test_windows.sh GSFIX.EXE SCENE SCRATCH: gsfix under Wine, with names that only the W functions can reach; a run that is killed
# and resumed; external restorers; files that are not gsfix's. SCENE: made by make_scene.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
exe=$1 scene=$2 scratch=$3
[ -f "$exe" ] && [ -d "$scene" ] || { echo "SKIPPED: no program or no scene"; exit 77; }
rm -rf "$scratch"
mkdir -p "$scratch/Größe_日本"
cp -r "$scene" "$scratch/Größe_日本/S"
cd "$scratch/Größe_日本"
export GSFIX_MODELS=$PWD
failures=0
fail() { echo "FAILED: $*"; failures=$((failures + 1)); }
gsfix() { "$here/cross/wine.sh" "$exe" "$@"; }
quick=(--views 3 --threads 1 --max-size 48 --checkpoint-every 2)
fix() { gsfix fix S "${quick[@]}" "$@"; }
says() { # TEXT COMMAND...: fails with this text
    local text=$1 status=0
    shift
    "$@" > said 2>&1 || status=$?
    [ $status != 0 ] || fail "no failure: $*"
    grep -q -e "$text" said || { fail "status $status, does not say \"$text\": $*"; tail -n 3 said; }
}

gsfix --version | grep -q kernels || fail "no version"
gsfix info S | grep -q "views" || fail "info"

# A run, a run in a deep folder, and one that is killed and goes on: the same splats.
fix --out Straße_1 --iterations 30 --restorer warp --json > json 2> log || { fail "fix"; tail -n 3 log; }
grep -q '"psnr":' json || fail "no figures"
[ -s Straße_1/splats.ply ] && [ -s Straße_1/report.html ] && ls Straße_1/test/*.png > /dev/null || fail "files are missing"
deep=$(printf 'tief_%050d/' 1 2 3 4 5)
fix --out "${deep}aus" --iterations 30 --restorer warp > log 2>&1 || { fail "fix in a deep folder"; tail -n 3 log; }
cmp -s Straße_1/splats.ply "${deep}aus/splats.ply" || fail "the deep folder has other splats"
(exec "$here/cross/wine.sh" "$exe" fix S "${quick[@]}" --out killed --iterations 30 --restorer warp > log 2>&1) &
run=$!
for i in $(seq 200); do [ -f killed/checkpoint ] && break; sleep 0.1; done
kill -9 $run 2> /dev/null || true
wait $run 2> /dev/null || true
fix --out killed --iterations 30 --restorer warp --resume > log 2>&1 || { fail "resumed"; tail -n 3 log; }
cmp -s Straße_1/splats.ply killed/splats.ply || fail "a resumed run has other splats"
gsfix render Straße_1/splats.ply --scene S --out bilder > log 2>&1 || { fail "render"; tail -n 3 log; }
[ "$(ls bilder | wc -l)" -ge 8 ] || fail "renders are missing"

# External restorers by cmd.exe; the job folder comes as an absolute path.
printf '@mkdir "%%~1\\out"\r\n@copy "%%~1\\frames\\*.png" "%%~1\\out" > nul\r\n' > restorer.cmd
printf '@exit 3\r\n' > fails.cmd
printf ':again\r\n@goto again\r\n' > hangs.cmd
fix --out copied --iterations 30 --restorer 'exec:restorer.cmd' > log 2>&1 || { fail "exec"; tail -n 3 log; }
ls -d copied/job-* > /dev/null 2>&1 && fail "a job folder is left"
says "ended with status 3" fix --out failed --iterations 30 --restorer 'exec:fails.cmd'
says "took longer than 2 s" fix --out hung --iterations 30 --restorer 'exec:hangs.cmd' --restorer-timeout 2

# Videos: a page, and a program in place of ffmpeg, fed through a pipe.
gsfix path S --views 3 --max-size 48 --frames 5 --out weg.json > log 2>&1 || { fail "path"; tail -n 3 log; }
render() { gsfix render Straße_1/splats.ply --path weg.json --out filme "$@"; }
render --video filme/Film.html > log 2>&1 || { fail "a page as video"; tail -n 3 log; }
[ -s filme/Film.html ] || fail "the page is missing"
says "needs ffmpeg" render --video filme/Film.mp4
mkdir "$scratch/bin"
cat > ffmpeg.c <<'C'
#include <fcntl.h>
#include <io.h>
#include <stdio.h>
#include <stdlib.h>
#include <windows.h>
int wmain(int argc, wchar_t** argv) {
    static char block[4096];
    const char* how = getenv("FAKE");
    size_t n;
    if (how && how[0] == 'h') Sleep(INFINITE);
    if (how && how[0] == 'f') return fprintf(stderr, "Unknown encoder\r\n"), 3;
    FILE* out = _wfopen(argv[argc - 1], L"wb");
    if (!out) return 4;
    _setmode(0, _O_BINARY);
    while ((n = fread(block, 1, sizeof block, stdin)) > 0) fwrite(block, 1, n, out);
    return fclose(out);
}
C
if x86_64-w64-mingw32-gcc -municode ffmpeg.c -o "$scratch/bin/ffmpeg.exe" 2> log; then
    folder=Z:$(cd "$scratch/bin" && pwd)/ # Wine's name for it
    export WINEPATH=${folder//\//\\}
    render --video filme/Film.mp4 > log 2>&1 || { fail "a video by a program"; tail -n 3 log; }
    [ "$(wc -c < filme/Film.mp4)" = $((5 * 48 * 32 * 3)) ] || fail "the program got $(wc -c < filme/Film.mp4) bytes"
    (export FAKE=fails; says "Film.webm: ffmpeg ended with status 3: Unknown encoder" render --video Film.webm; [ $failures = 0 ]) || failures=$((failures + 1))
    [ ! -e Film.webm ] && [ ! -e filme/.gsfix/draft ] || fail "something is left of a failed video"
fi

# What is not gsfix's stays.
echo mine > Straße_1/splats.ply
says "not written by gsfix" fix --out Straße_1 --iterations 30 --restart
[ "$(cat Straße_1/splats.ply)" = mine ] || fail "a foreign file was replaced"
says "input is read from there" fix --out S --iterations 30
[ $failures = 0 ] || exit 1
echo "all passed"
