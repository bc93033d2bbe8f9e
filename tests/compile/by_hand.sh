#!/usr/bin/env bash
# by_hand.sh: the line at the head of each example that says how to compile it does so (syntax only, and without warnings).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
found=0
for file in examples/*.c; do
    line=$(head -n 3 "$file" | grep -oE '\bg?cc -O2 .*-o [a-z_]+' | head -n 1) || continue
    found=$((found + 1))
    echo "$file: $line"
    # shellcheck disable=SC2086 # words are meant to be split
    ${line%% -o *} -fsyntax-only -Wall -Wextra -Werror
done
[ "$found" -ge 6 ] || { echo "by_hand.sh: only $found examples say how" >&2; exit 1; }
