#!/usr/bin/env bash
# tests/stack.sh CC FOLDER...: no function of the headers takes more than 16 KB of stack optimised nor more than 32 KB at -O0, so
# that threads with small stacks can call them. Each FOLDER has .su files of the optimised build (gcc -fstack-usage); the headers
# are compiled anew at -O0 by CC.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
cc=$1
shift
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
{
    echo "#define GSFIXER_IMPLEMENTATION"
    for header in gsfixer*.h; do echo "#include \"$PWD/$header\""; done
} > "$scratch/unit.c"
(cd "$scratch" && "$cc" -std=c11 -O0 -w -DGSF_NN_TRAINING -fstack-usage -c unit.c)
status=0
largest() { # MOST NAME FILE...: place, bytes and kind of each function of a header, separated by tabs
    awk -F '\t' -v most="$1" -v name="$2" '
        $1 !~ /gsfixer[a-z_]*\.h:/ { next }
        { count++ }
        $2 > worst { worst = $2; where = $1 }
        $2 > most || $3 == "dynamic" { print "FAILED: " $1 ": " $2 " bytes, " $3; bad = 1 }
        END { printf "%s: %d functions, %d bytes at most, %s\n", name, count, worst, where; exit bad || count < 1000 }' "${@:3}" /dev/null ||
        status=1
}
mapfile -t optimised < <(find "$@" -name '*.su')
largest 16384 optimised "${optimised[@]}"
largest 32768 "-O0" "$scratch"/*.su
exit $status
