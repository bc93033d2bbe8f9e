#!/usr/bin/env bash
# count.sh TEST_PLATFORMS SCRATCH: of 64-bit Arm's instructions, NEON executes at most a quarter of the scalar kernels', for
# rendering and for the way back. Counted by a plugin of QEMU; one run less from three leaves two repetitions.
set -euo pipefail
program=$1 scratch=$2
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
mkdir -p "$scratch"
gcc -std=c11 -O1 -shared -fPIC "$here/count.c" -o "$scratch/count.so"
count() { qemu-aarch64 -L /usr/aarch64-linux-gnu -d plugin -plugin "$scratch/count.so" "$program" "$1" "$2" "$3" 2>&1 | sed -n 's/^instructions //p'; }
declare -A work
for kind in render backward; do
    for level in scalar best; do
        one=$(count $kind $level 1) three=$(count $kind $level 3)
        [ -n "$one" ] && [ -n "$three" ] || { echo "SKIPPED: QEMU does not count"; exit 77; }
        work[$kind,$level]=$(((three - one) / 2))
    done
done
failed=0
compare() { # NAME SCALAR NEON
    echo "$1: $2 instructions by the scalar kernels, $3 by NEON: $(($2 * 100 / $3)) %"
    [ $(($3 * 4)) -le "$2" ] || failed=1
}
compare render "${work[render,scalar]}" "${work[render,best]}"
compare backward $((work[backward,scalar] - work[render,scalar])) $((work[backward,best] - work[render,best]))
[ $failed = 0 ] || { echo "FAILED: less than four times as many"; exit 1; }
