#!/usr/bin/env bash
# tests/stack.sh FOLDER [CC]: no function of the headers takes more than 16 KB of stack optimised, nor 64 KB at -O0, so that
# threads with small stacks can call them. FOLDER has the .su files of the optimised build (gcc -fstack-usage); the headers are
# compiled anew at -O0 by CC (gcc).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
folder=$1 cc=${2:-gcc}
[ -n "$(find "$folder" -name '*.su')" ] || { echo "SKIPPED: no .su files in $folder"; exit 77; }
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
for header in gsfixer_splat gsfixer_nn; do
    "$cc" -std=c11 -O0 -fstack-usage -DGSFIXER_IMPLEMENTATION -DGSF_NO_STB -I. -x c -c $header.h -o "$scratch/$header.o"
done
status=0
largest() { # MOST NAME FILE...: place, bytes and kind of each function, separated by tabs
    awk -F '\t' -v most="$1" -v name="$2" '
        $1 ~ /gsf/ && $2 > worst { worst = $2; where = $1 }
        $1 ~ /gsf/ && ($2 > most || $3 == "dynamic") { print "FAILED: " $1 ": " $2 " bytes, " $3; bad = 1 }
        END { printf "%s: %d bytes at most, %s\n", name, worst, where; exit bad || !worst }' "${@:3}" || status=1
}
largest 16384 optimised $(find "$folder" -name '*.su')
largest 65536 "-O0" "$scratch"/*.su
exit $status
