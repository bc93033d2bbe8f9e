#!/usr/bin/env bash
# stack.sh [LEVEL]: no function of the headers takes more than 32 KB of stack, compiled by gcc at -O0 (or LEVEL); at other levels
# none takes more than 16 KB but the convolution, whose tile of outputs fills a first-level cache.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
level=${1:--O0}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
{
    echo "#define GSFIXER_IMPLEMENTATION"
    for header in "$root"/gsfixer*.h; do echo "#include \"$header\""; done
} > "$work/unit.c"
(cd "$work" && gcc -std=c11 "$level" -w -DGSF_NN_TRAINING -fstack-usage -c unit.c)
sort -t "$(printf '\t')" -k 2 -rn "$work/unit.su" > "$work/sorted"
sed -n "s|^$root/||; 1,3p" "$work/sorted"
most=$(head -n 1 "$work/sorted" | cut -f 2)
[ "$(wc -l < "$work/sorted")" -gt 100 ] && [ "$most" -le 32768 ] || { echo "FAILED: $most bytes of stack"; exit 1; }
[ "$level" = -O0 ] && exit
most=$(awk -F '\t' '!/gsf__conv_segment/ { print $2; exit }' "$work/sorted")
[ "$most" -le 16384 ] || { echo "FAILED: $most bytes of stack at $level"; exit 1; }
