#!/usr/bin/env bash
# speed.sh FACTOR COMMAND...: test_platforms renders at least FACTOR times as fast with vectors as with the scalar kernels. The
# best of several turns each, taken alternately, since other programs may share the machine.
set -euo pipefail
factor=$1
shift
seconds() { "$@" | sed -n 's/.* \([0-9.]*\) s.*/\1/p'; }
scalar=1e9 best=1e9
for turn in 1 2 3 4 5; do
    a=$(seconds "$@" render scalar 20) b=$(seconds "$@" render best 20)
    scalar=$(awk "BEGIN { print $a < $scalar ? $a : $scalar }") best=$(awk "BEGIN { print $b < $best ? $b : $best }")
done
awk "BEGIN { printf \"scalar %g s, vectors %g s: %.2f times as fast\n\", $scalar, $best, $scalar / $best; exit !($scalar >= $factor * $best) }" ||
    { echo "FAILED: expected $factor"; exit 1; }
